from tests.tuner.exporters.test_export import EFFECTIVE
from tuner.coefficients import Written
from tuner.result import PoseRmse
from tuner.wording.result import effective_in_words, rmse_in_words, what_is_lost


def test_the_second_answer_is_said_with_what_it_costs():
    assert effective_in_words(EFFECTIVE) == (
        "Gazebo cannot fly fuselage_drag. With its effective coefficients it misses the flights by "
        "1.2 cm and 0.2°, the physical model by 2 mm and 0.1°; with the physical coefficients and "
        "without these terms it would be 5 cm and 0.4°."
    )
    carrying = EFFECTIVE.model_copy(update={"carried": ("center_of_mass_x",)})
    assert effective_in_words(carrying).endswith("Gazebo has a place for center_of_mass_x.")


def test_a_crash_and_a_metre_are_said_as_such():
    assert rmse_in_words(PoseRmse(position=None, attitude=None)) == "a crash"
    assert rmse_in_words(PoseRmse(position=2.345, attitude=12.0)) == "2.35 m and 12°"


def test_what_a_target_holds_is_not_lost_there():
    assert what_is_lost(EFFECTIVE, lambda _: Written("a tag")) == ()
