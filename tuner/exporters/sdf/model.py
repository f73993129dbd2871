"""The multirotor of a model file: links, their common mass, motors and control channels.

Poses and tensors are in the model's frame unless stated otherwise, in SI units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.exporters.sdf.spans import MERGED, Element, model_in, pose_numbers


@dataclass(frozen=True)
class Pose:
    """Position (3,) m and rotation (3, 3) of a frame in another."""

    position: Array
    rotation: Array

    def __matmul__(self, inner: Pose) -> Pose:
        """Return the pose of an inner frame in the outer one."""
        return Pose(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)


@dataclass(frozen=True)
class Inertial:
    """A body: mass in kg, pose of its centre of mass, inertia about that point.

    ``pose`` places the inertial frame; ``inertia`` (3, 3) kg m² is along that frame's axes.
    """

    mass: float
    pose: Pose
    inertia: Array

    @property
    def in_model(self) -> Array:
        """The inertia along the model's axes."""
        return self.pose.rotation @ self.inertia @ self.pose.rotation.T


def pose_of(numbers: Sequence[float]) -> Pose:
    """Return SDF's ``x y z roll pitch yaw`` (m, rad; fixed axes) as a pose."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    rotation = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
    return Pose(np.array(numbers[:3], dtype=np.float64), rotation)


IDENTITY = Pose(np.zeros(3), np.eye(3))


def join_bodies(bodies: Sequence[Inertial]) -> Inertial:
    """Return rigidly joined bodies as one, about their common centre of mass."""
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.pose.position for body in bodies), np.zeros(3)) / mass
    inertia = sum((_inertia_about(centre, body) for body in bodies), np.zeros((3, 3)))
    return Inertial(mass, Pose(centre, np.eye(3)), inertia)


def base_for(
    whole_mass: float,
    whole_inertia: Array,
    base: Pose,
    others: Sequence[Inertial],
    *,
    centre: Array | None = None,
) -> Inertial:
    """Return the base body that gives, with the others, the wanted whole.

    Parameters
    ----------
    whole_mass
        kg.
    whole_inertia
        (3, 3) kg m², about the common centre of mass, along the model's axes.
    base
        Inertial frame of the base, which stays unless a centre is given.
    centre
        (3,) the wanted common centre of mass; None for any.

    Raises
    ------
    ValueError
        No such body exists: the others have too much mass or inertia.
    """
    mass = whole_mass - sum(other.mass for other in others)
    if mass <= 0:
        raise ValueError(
            f"the links beside the base weigh {whole_mass - mass:.6g} kg, the vehicle only "
            f"{whole_mass:.6g} kg"
        )
    if centre is not None:
        moment = sum((other.mass * other.pose.position for other in others), np.zeros(3))
        base = Pose((whole_mass * centre - moment) / mass, base.rotation)
    bare = Inertial(mass, base, np.zeros((3, 3)))
    centre = join_bodies((bare, *others)).pose.position
    rest = _inertia_about(centre, bare) + sum(
        (_inertia_about(centre, other) for other in others), np.zeros((3, 3))
    )
    in_model = whole_inertia - rest
    moments = np.linalg.eigvalsh(in_model)
    if moments[0] <= 0 or moments[2] > moments[0] + moments[1]:
        raise ValueError(
            "the links beside the base carry more inertia than the vehicle's allows: "
            f"the base would have the principal moments {moments.round(9).tolist()} kg m²"
        )
    return Inertial(mass, base, base.rotation.T @ in_model @ base.rotation)


def _inertia_about(point: Array, body: Inertial) -> Array:
    """Return a body's inertia about a point, along the model's axes."""
    arm = body.pose.position - point
    shift: Array = arm @ arm * np.eye(3) - np.outer(arm, arm)
    return body.in_model + body.mass * shift


#: Names of the motor model and the control channels in the two simulators.
_CLASSIC_MOTOR = "gazebo_motor_model"
_GZ_MOTOR = "multicopter-motor-model"
_CLASSIC_CHANNELS = "control_channels"
MAX_ROTORS = 12
"""Motors with a larger number drive something else."""


@dataclass(frozen=True)
class Model:
    """A parsed model file.

    Attributes
    ----------
    base
        The ``<link>`` whose inertial an export sets.
    """

    root: Element
    base: Element
    rotors: int

    @property
    def path(self) -> Path:
        """The main file."""
        return self.root.source.path

    @property
    def links(self) -> list[Element]:
        """All links of the model and of merged ones."""
        return [element for element, _ in _members(self.root, IDENTITY) if element.tag == "link"]

    @property
    def included(self) -> list[str]:
        """The URIs of includes, whose mass is unknown."""
        uris = (include.find("uri") for include in self.root.all("include"))
        return [uri.value for uri in uris if uri is not None]

    @property
    def is_gz(self) -> bool:
        """Whether its motors are gz-sim's, not Gazebo classic's."""
        return any(_GZ_MOTOR in _plugin_names(motor) for motor in self.motors())

    def rotor_links(self) -> dict[int, tuple[Element, str]]:
        """Return number of a motor -> its rotor's link, and ``ccw`` or ``cw`` (empty if unknown).

        Motors without a number or link, as in a template, are left out.
        """
        links = {link.attributes.get("name"): link for link in self.links}
        rotors = {}
        for motor in self.motors():
            number = self.motor_number(motor)
            named, turns = (motor.find(tag) for tag in ("linkName", "turningDirection"))
            link = links.get(named.value) if named else None
            if number is not None and link is not None:
                rotors[number] = (link, turns.value if turns else "")
        return rotors

    def motors(self) -> list[Element]:
        """Return the motor plugins of the rotors, with those of templates without number."""
        plugins = []
        for plugin in self.root.all("plugin"):
            names = _plugin_names(plugin)
            if _CLASSIC_MOTOR in names or _GZ_MOTOR in names:
                index = plugin.numbers.get("motorNumber")
                if index is None or 0 <= index < self.rotors:
                    plugins.append(plugin)
        return plugins

    def motor_number(self, motor: Element) -> int | None:
        """Return the number of a motor plugin's rotor; None if a template has none."""
        index = motor.numbers.get("motorNumber")
        return None if index is None else int(index)

    def channels(self) -> list[Element]:
        """Return the control channels of the vehicle's rotors (Gazebo classic only)."""
        channels = []
        for parent in self.root.all(_CLASSIC_CHANNELS):
            for channel in parent.children:
                index = channel.numbers.get("input_index")
                kind = channel.find("joint_control_type")
                drives = kind is None or kind.value.startswith("velocity")
                if (
                    channel.tag == "channel"
                    and drives
                    and (index is None or 0 <= index < self.rotors)
                ):
                    channels.append(channel)
        return channels

    def pose_of_link(self, link: Element) -> Pose:
        """Return the pose of a link in the model's frame.

        Raises
        ------
        ExportError
            Its reference frame is no link or frame of the model.
        """
        return self._pose_in_model(link, ())

    def pose_of_inertial(self, link: Element) -> Pose:
        """Return the pose of a link's inertial frame in the model's frame."""
        inertial = link.find("inertial")
        return self.pose_of_link(link) @ (self._written_pose(inertial) if inertial else IDENTITY)

    def _written_pose(self, element: Element) -> Pose:
        """Return an element's ``<pose>`` in its own reference frame."""
        pose, numbers = element.find("pose"), pose_numbers(element)
        if pose is None or not numbers:
            return IDENTITY
        if pose.attributes.get("rotation_format", "euler_rpy") != "euler_rpy":
            raise ExportError(
                self.path, "has a pose that is not in euler_rpy", "write it as x y z roll pitch yaw"
            )
        if pose.attributes.get("degrees", "false") == "true":
            numbers[3:] = np.deg2rad(numbers[3:]).tolist()
        return pose_of(numbers)

    def _pose_in_model(self, element: Element, passed: tuple[str, ...]) -> Pose:
        pose = element.find("pose")
        named = pose.attributes.get("relative_to", "") if pose else ""
        frame = named or element.attributes.get("attached_to", "")
        if frame in {"", "__model__"}:
            within = next(
                (at for member, at in _members(self.root, IDENTITY) if member is element), IDENTITY
            )
            return within @ self._written_pose(element)
        return self._pose_of_frame(frame, passed) @ self._written_pose(element)

    def _pose_of_frame(self, name: str, passed: tuple[str, ...]) -> Pose:
        for element, _ in _members(self.root, IDENTITY):
            same = element.attributes.get("name") == name
            if same and element.tag in {"link", "frame"} and name not in passed:
                return self._pose_in_model(element, (*passed, name))
        raise ExportError(
            self.path, f"has a pose relative to '{name}'", "give it relative to a link or frame"
        )


def _plugin_names(plugin: Element) -> str:
    """Return file and name of a plugin; gz-sim's motor model has one spelling."""
    names = plugin.attributes.get("filename", "") + plugin.attributes.get("name", "")
    return names.replace("MulticopterMotorModel", _GZ_MOTOR)


def read_model(root: Element, rotors: int) -> Model:
    """Return the model of a parsed file.

    Raises
    ------
    ExportError
        It holds no model, no link, or no motor plugin.
    """
    element, path = model_in(root), root.source.path
    links = [member for member, _ in _members(element, IDENTITY) if member.tag == "link"]
    missing = [include for include in element.all("include") if include.attributes.get("merge")]
    if not links:
        remedy = "give the SDF of a multirotor"
        if missing:
            remedy = "put the folders of the models that it includes beside its own"
        raise ExportError(path, "has no <link>", remedy)
    model = Model(element, _base_link(element, links), rotors)
    if not model.motors():
        raise ExportError(
            path,
            "has no motor model plugin",
            "give a model for PX4's motor model plugins: where it is split over files, the one "
            "that includes the others",
        )
    return model


def _members(parent: Element, frame: Pose) -> Iterator[tuple[Element, Pose]]:
    """Yield an element's children and those of merged models, and the frame of each."""
    for child in parent.children:
        if child.tag == MERGED:
            numbers = [float(word) for word in child.attributes["at"].split()]
            yield from _members(child.children[0], frame @ pose_of(numbers))
        else:
            yield child, frame


def _base_link(root: Element, links: list[Element]) -> Element:
    by_name = {link.attributes.get("name", ""): link for link in links}
    for name in (root.attributes.get("canonical_link", ""), "base_link"):
        if name in by_name:
            return by_name[name]
    return links[0]


def inertials(model: Model) -> Iterator[tuple[Element, Inertial]]:
    """Yield each link with mass, and its body in the model's frame."""
    for link in model.links:
        inertial = link.find("inertial")
        if inertial is None:
            continue
        mass = inertial.numbers.get("mass")
        if mass is None:
            raise ExportError(
                model.path,
                f"link '{link.attributes.get('name')}' has no mass that is a number",
                "write it as one",
            )
        tensor = inertial.find("inertia")
        given = tensor.numbers if tensor else {}
        matrix = np.array(
            [[given.get(f"i{min(a, b)}{max(a, b)}", 0.0) for b in "xyz"] for a in "xyz"]
        )
        yield link, Inertial(mass, model.pose_of_inertial(link), matrix)


def composite(model: Model) -> Inertial:
    """Return all links of a model as one body."""
    return join_bodies([body for _, body in inertials(model)])
