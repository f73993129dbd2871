import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.exporters.sdf.composite import Inertial, Pose, base_for, pose_of, together


def solid_box(mass, pose, sides):
    x, y, z = (np.asarray(sides) ** 2).tolist()
    return Inertial(mass, pose, mass / 12 * np.diag([y + z, x + z, x + y]))


def test_two_half_bars_are_a_bar():
    halves = [solid_box(1.0, pose_of([side, 0, 0, 0, 0, 0]), [1, 0.1, 0.1]) for side in (-0.5, 0.5)]
    bar = solid_box(2.0, pose_of([0] * 6), [2, 0.1, 0.1])
    assert together(halves).mass == 2
    np.testing.assert_allclose(together(halves).inertia, bar.inertia, atol=1e-15)
    np.testing.assert_allclose(together(halves).pose.position, 0, atol=1e-15)


def test_a_quarter_turn_about_z_swaps_x_and_y():
    turned = pose_of([1, 2, 3, 0, 0, np.pi / 2])
    np.testing.assert_allclose(turned.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    box = Inertial(1.0, turned, np.diag([1.0, 2.0, 2.5]))
    np.testing.assert_allclose(box.in_model, np.diag([2.0, 1.0, 2.5]), atol=1e-15)


def test_angles_are_about_fixed_axes_roll_first():
    both = pose_of([0, 0, 0, np.pi / 2, np.pi / 2, 0]).rotation
    np.testing.assert_allclose(both @ [0, 1, 0], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-15)


def test_poses_chain():
    outer, inner = pose_of([1, 0, 0, 0, 0, np.pi / 2]), pose_of([1, 0, 0, 0, 0, 0])
    np.testing.assert_allclose((outer @ inner).position, [1, 1, 0], atol=1e-15)


@given(
    st.lists(
        st.tuples(st.floats(0.001, 0.05), *[st.floats(-0.2, 0.2)] * 3, *[st.floats(-3, 3)] * 3),
        max_size=5,
    ),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3, *[st.floats(-3, 3)] * 3),
)
def test_base_and_others_together_are_the_wanted_whole(others, base):
    bodies = [solid_box(mass, pose_of(pose), [0.02, 0.1, 0.03]) for mass, *pose in others]
    wanted = np.diag([0.05, 0.06, 0.08])
    base_body = base_for(2.0, wanted, pose_of(base), bodies)
    whole = together([base_body, *bodies])
    assert whole.mass == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(whole.inertia, wanted, atol=1e-14)


def test_the_base_moves_to_where_the_common_centre_is_wanted():
    other = solid_box(0.5, pose_of([0.1, 0, 0.05, 0, 0, 1.0]), [0.02, 0.1, 0.03])
    wanted, centre = np.diag([0.05, 0.06, 0.08]), np.array([0.003, -0.002, 0.015])
    base = base_for(2.0, wanted, pose_of([0.3, 0, 0, 0.2, 0, 0]), [other], centre=centre)
    whole = together([base, other])
    np.testing.assert_allclose(whole.pose.position, centre, atol=1e-16)
    np.testing.assert_allclose(whole.inertia, wanted, atol=1e-14)


def test_links_heavier_than_the_vehicle_are_refused():
    heavy = solid_box(3.0, pose_of([0] * 6), [1, 1, 1])
    with pytest.raises(ValueError, match="weigh 3 kg, the vehicle only 2 kg"):
        base_for(2.0, np.diag([0.05, 0.06, 0.08]), pose_of([0] * 6), [heavy])
    far = Inertial(0.5, Pose(np.array([0.5, 0, 0]), np.eye(3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="more inertia than"):
        base_for(2.0, np.diag([0.05, 0.06, 0.08]), pose_of([0] * 6), [far])
