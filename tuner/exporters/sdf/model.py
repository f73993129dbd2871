"""The multirotor of a model: its files, links, their common mass, motors and control channels.

A model of several files is one tree, in which each ``<include merge="true">`` holds the included
model, as simulators merge it. Includes are followed within the parent of the model's folder. Poses
and tensors are in the model's frame unless stated otherwise, in SI units.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.exporters.sdf.spans import Element, parse, render
from tuner.exporters.target import read_file


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

    def inertia_about(self, point: Array) -> Array:
        """Return the inertia (3, 3) about a point (3,), along the model's axes."""
        arm = self.pose.position - point
        shift: Array = arm @ arm * np.eye(3) - np.outer(arm, arm)
        return self.pose.rotation @ self.inertia @ self.pose.rotation.T + self.mass * shift


def pose_from(numbers: Sequence[float]) -> Pose:
    """Return SDF's ``x y z roll pitch yaw`` (m, rad; fixed axes) as a pose."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    rotation = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
    return Pose(np.array(numbers[:3], dtype=np.float64), rotation)


IDENTITY = Pose(np.zeros(3), np.eye(3))


def join_bodies(bodies: Sequence[Inertial]) -> Inertial:
    """Return rigidly joined bodies as one, about their common centre of mass."""
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.pose.position for body in bodies), np.zeros(3)) / mass
    inertia = sum((body.inertia_about(centre) for body in bodies), np.zeros((3, 3)))
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
    rest = sum((body.inertia_about(centre) for body in (*others, bare)), np.zeros((3, 3)))
    in_model = whole_inertia - rest
    moments = np.linalg.eigvalsh(in_model)
    if moments[0] <= 0 or moments[2] > moments[0] + moments[1]:
        raise ValueError(
            "the links beside the base carry more inertia than the vehicle's allows: "
            f"the base would have the principal moments {moments.round(9).tolist()} kg m²"
        )
    return Inertial(mass, base, base.rotation.T @ in_model @ base.rotation)


#: Names of the motor model and the control channels in the two simulators.
_CLASSIC_MOTOR = "gazebo_motor_model"
_GZ_MOTOR = "multicopter-motor-model"
_CLASSIC_CHANNELS = "control_channels"
MAX_ROTORS = 12
"""Motors with a larger number drive something else."""
MAX_FILES = 16
"""Of one model."""
MERGED = "merged__"
"""Tag of an include that holds the included model."""
_NAME = re.compile(r"(?:model://)?([A-Za-z0-9_][A-Za-z0-9._-]{0,99})/?")


@dataclass(frozen=True)
class SdfModel:
    """A parsed model.

    Attributes
    ----------
    root
        Its ``<model>``.
    members
        Its elements and those of merged models, each with the pose of its own model in this one.
    base
        The ``<link>`` whose inertial an export sets.
    rotors
        Motors with this number or a larger one drive something else.
    """

    root: Element
    members: Sequence[tuple[Element, Pose]]
    base: Element
    rotors: int

    @property
    def path(self) -> Path:
        """The main file."""
        return self.root.source.path

    @property
    def links(self) -> list[Element]:
        """All links of the model and of merged ones."""
        return [element for element, _ in self.members if element.tag == "link"]

    @property
    def included(self) -> list[str]:
        """The URIs of includes and the names of models inside, whose mass is not counted."""
        uris = (include.find("uri") for include in self.root.all("include"))
        inside = (member for member, _ in self.members if member.tag == "model")
        return [
            *(uri.value for uri in uris if uri is not None),
            *(model.attributes.get("name", "") for model in inside),
        ]

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
            number = motor_number(motor)
            named, turns = (motor.find(tag) for tag in ("linkName", "turningDirection"))
            link = links.get(named.value) if named else None
            if number is not None and link is not None:
                rotors[number] = (link, turns.value if turns else "")
        return rotors

    def motors(self) -> list[Element]:
        """Return the motor plugins of the rotors, with those of templates without number."""
        return [motor for motor in _motors_in(self.root) if self._is_rotors(motor, "motorNumber")]

    def channels(self) -> list[Element]:
        """Return the control channels of the vehicle's rotors (Gazebo classic only)."""
        return [
            channel
            for parent in self.root.all(_CLASSIC_CHANNELS)
            for channel in parent.children
            if channel.tag == "channel" and self._is_rotors(channel, "input_index")
            if (kind := channel.find("joint_control_type")) is None
            or kind.value.startswith("velocity")
        ]

    def _is_rotors(self, element: Element, tag: str) -> bool:
        """Return whether an element's number is a rotor's, or missing."""
        return 0 <= element.numbers.get(tag, 0) < self.rotors

    def pose_of(self, element: Element, passed: tuple[str, ...] = ()) -> Pose:
        """Return the pose of a link or frame in the model's frame.

        Raises
        ------
        ExportError
            Its reference frame is no link or frame of the model, or one of those ``passed``.
        """
        pose = element.find("pose")
        named = pose.attributes.get("relative_to", "") if pose else ""
        frame = named or element.attributes.get("attached_to", "")
        if frame in {"", "__model__"}:
            outer = next(at for member, at in self.members if member is element)
            return outer @ self._written_pose(element)
        for other, _ in self.members:
            same = other.attributes.get("name") == frame
            if same and other.tag in {"link", "frame"} and frame not in passed:
                return self.pose_of(other, (*passed, frame)) @ self._written_pose(element)
        raise ExportError(
            self.path, f"has a pose relative to '{frame}'", "give it relative to a link or frame"
        )

    def pose_of_inertial(self, link: Element) -> Pose:
        """Return the pose of a link's inertial frame in the model's frame."""
        inertial = link.find("inertial")
        return self.pose_of(link) @ (self._written_pose(inertial) if inertial else IDENTITY)

    def _written_pose(self, element: Element) -> Pose:
        """Return an element's ``<pose>`` in its own reference frame."""
        pose, numbers = element.find("pose"), _pose_numbers(element)
        if pose is None or not numbers:
            return IDENTITY
        if pose.attributes.get("rotation_format", "euler_rpy") != "euler_rpy":
            raise ExportError(
                self.path, "has a pose that is not in euler_rpy", "write it as x y z roll pitch yaw"
            )
        if pose.attributes.get("degrees", "false") == "true":
            numbers[3:] = np.deg2rad(numbers[3:]).tolist()
        return pose_from(numbers)


def motor_number(motor: Element) -> int | None:
    """Return the number of a motor plugin's rotor; None if a template has none."""
    index = motor.numbers.get("motorNumber")
    return None if index is None else int(index)


def _motors_in(model: Element) -> Iterator[Element]:
    """Yield the motor plugins inside a model."""
    for plugin in model.all("plugin"):
        names = _plugin_names(plugin)
        if _CLASSIC_MOTOR in names or _GZ_MOTOR in names:
            yield plugin


def _plugin_names(plugin: Element) -> str:
    """Return file and name of a plugin; gz-sim's motor model has one spelling."""
    names = plugin.attributes.get("filename", "") + plugin.attributes.get("name", "")
    return names.replace("MulticopterMotorModel", _GZ_MOTOR)


def _pose_numbers(element: Element) -> list[float]:
    """Return the six numbers of an element's ``<pose>``; an empty list without one."""
    pose = element.find("pose")
    words = pose.value.split() if pose else []
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [0.0]
    if len(numbers) not in (0, 6) or not all(map(math.isfinite, numbers)):
        what = f"has the pose '{' '.join(words)}'"
        raise ExportError(element.source.path, what, "write six numbers")
    return numbers


def read_sdf(
    path: Path,
    rotors: int,
    *,
    texts: Mapping[Path, str] = MappingProxyType({}),
    prepare: Callable[[str, Path], str] = render,
) -> SdfModel:
    """Return the model of a file and of those that it includes.

    Parameters
    ----------
    texts
        File -> its text, for those that are not read.
    prepare
        Text and path -> the XML to parse, with the same positions if it is to be edited.

    Raises
    ------
    ExportError
        A file cannot be read, or is included twice, as in itself; or as of `sdf_of`.
    """
    files: list[Path] = []

    def read(file: Path) -> Element:
        if file in files:
            raise ExportError(file, "is included twice, or in itself", "take the include out")
        files.append(file)
        if len(files) > MAX_FILES:
            what = f"is one of more than {MAX_FILES} files of a model"
            raise ExportError(file, what, "take includes out")
        raw = texts[file] if file in texts else read_file(file)
        root = parse(prepare(raw, file), file, raw)
        if root.first("include") is not None:
            for include in _model_in(root).children:
                included = _included_file(include)
                if included is not None:
                    model = _model_in(read(included))
                    at = _pose_of_include(include) or _pose_of_include(model)
                    include.tag, include.children, include.at = MERGED, [model], at
        return root

    return sdf_of(read(path), rotors)


def _model_in(root: Element) -> Element:
    """Return the ``<model>`` of a file that has motors, else its first."""
    models = [root] if root.tag == "model" else [*_outermost_models(root)]
    if not models:
        raise ExportError(root.source.path, "holds no <model>", "give the SDF of a multirotor")
    flying = [model for model in models if next(_motors_in(model), None)]
    if len(flying) > 1:
        names = ", ".join(f"'{model.attributes.get('name', '')}'" for model in flying)
        raise ExportError(
            root.source.path, f"holds several multirotors: {names}", "give each a file of its own"
        )
    return (flying or models)[0]


def _outermost_models(parent: Element) -> Iterator[Element]:
    for child in parent.children:
        if child.tag == "model":
            yield child
        else:
            yield from _outermost_models(child)


def _included_file(include: Element) -> Path | None:
    """Return the file that an element merges; None if it is not followed."""
    if include.tag != "include" or include.attributes.get("merge") not in ("true", "1"):
        return None
    uri = include.find("uri")
    name = None if uri is None else _NAME.fullmatch(uri.value)
    if name is None:
        return None
    tree = include.source.path.absolute().parent.parent
    file = tree / name.group(1) / "model.sdf"
    return file if file.resolve().is_relative_to(tree.resolve()) and file.is_file() else None


def _pose_of_include(element: Element) -> list[float]:
    """Return the six numbers of the pose of an include or an included model, if it has one."""
    pose, numbers = element.find("pose"), _pose_numbers(element)
    frame = pose.attributes if pose and numbers else {}
    if frame.get("relative_to") or frame.get("degrees") == "true":
        raise ExportError(
            element.source.path,
            "includes a model at a pose that is not in radians from its own frame",
            "write it as x y z roll pitch yaw",
        )
    return numbers


def sdf_of(root: Element, rotors: int) -> SdfModel:
    """Return the model of a parsed file.

    Raises
    ------
    ExportError
        It holds no model, no link, or no motor plugin.
    """
    element, path = _model_in(root), root.source.path
    members = tuple(_members(element, IDENTITY))
    links = [member for member, _ in members if member.tag == "link"]
    if not links:
        remedy = "give the SDF of a multirotor"
        if any(include.attributes.get("merge") for include in element.all("include")):
            remedy = "put the folders of the models that it includes beside its own"
        raise ExportError(path, "has no <link>", remedy)
    by_name = {link.attributes.get("name", ""): link for link in links}
    named = (element.attributes.get("canonical_link", ""), "base_link")
    base = next((by_name[name] for name in named if name in by_name), links[0])
    model = SdfModel(element, members, base, rotors)
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
            inner = frame @ pose_from(child.at) if child.at else frame
            yield from _members(child.children[0], inner)
        else:
            yield child, frame


def inertials(model: SdfModel) -> Iterator[tuple[Element, Inertial]]:
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


def composite(model: SdfModel) -> Inertial:
    """Return all links of a model as one body."""
    return join_bodies([body for _, body in inertials(model)])
