"""What a model file holds of a multirotor: its links, motor plugins and control channels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.errors import ExportError
from tuner.exporters.sdf.composite import IDENTITY, Inertial, Pose, pose_of
from tuner.exporters.sdf.includes import MERGED, model_in
from tuner.exporters.sdf.spans import Element, content, number, parse

#: How each of the two simulators calls its motor model and its control channels.
_CLASSIC_MOTOR = "gazebo_motor_model"
_GZ_MOTOR = "multicopter-motor-model"
_CLASSIC_CHANNELS = "control_channels"


@dataclass(frozen=True)
class Model:
    """A model file taken apart.

    Attributes
    ----------
    path, text
        The file.
    root
        Its ``<model>``.
    base
        The ``<link>`` whose inertial is ours to set.
    rotors
        How many rotors the vehicle has.
    """

    path: Path
    text: str
    root: Element
    base: Element
    rotors: int

    @property
    def links(self) -> list[Element]:
        """Every link of the model itself, and of what it takes in."""
        return [element for element, _ in self._members() if element.tag == "link"]

    def _members(self) -> Iterator[tuple[Element, Pose]]:
        """Yield what the model holds, and the frame that it counts from."""
        return _inside(self.root, IDENTITY)

    @property
    def included(self) -> list[str]:
        """What the model includes from other files, whose mass we cannot see."""
        uris = (include.find("uri") for include in self.root.all("include"))
        return [content(uri, self.text) for uri in uris if uri is not None]

    @property
    def is_gz(self) -> bool:
        """Whether its motors are gz-sim's, not Gazebo classic's."""
        return any(_GZ_MOTOR in _named(motor) for motor in self.motors())

    def rotor_links(self) -> dict[int, tuple[Element, str]]:
        """Return number of a motor -> its rotor's link, and ``ccw`` or ``cw`` (empty where open).

        Motors whose number or link a template leaves open are not there.
        """
        links = {link.attributes.get("name"): link for link in self.links}
        rotors = {}
        for motor in self.motors():
            number = self.motor_number(motor)
            named, turns = (motor.find(tag) for tag in ("linkName", "turningDirection"))
            link = links.get(content(named, self.text)) if named else None
            if number is not None and link is not None:
                rotors[number] = (link, content(turns, self.text) if turns else "")
        return rotors

    def motors(self) -> list[Element]:
        """Return the motor plugins of the vehicle's rotors.

        Those of a template without a number of their own, as in a macro, count as well.
        """
        plugins = []
        for plugin in self.root.all("plugin"):
            names = _named(plugin)
            if _CLASSIC_MOTOR in names or _GZ_MOTOR in names:
                index = self._number_in(plugin, "motorNumber")
                if index is None or 0 <= index < self.rotors:
                    plugins.append(plugin)
        return plugins

    def motor_number(self, motor: Element) -> int | None:
        """Return which rotor a motor plugin drives; None where a template leaves that open."""
        index = self._number_in(motor, "motorNumber")
        return None if index is None else int(index)

    def channels(self) -> list[Element]:
        """Return the control channels of the vehicle's rotors (Gazebo classic only)."""
        channels = []
        for parent in self.root.all(_CLASSIC_CHANNELS):
            for channel in parent.children:
                index = self._number_in(channel, "input_index")
                kind = channel.find("joint_control_type")
                drives = kind is None or content(kind, self.text).startswith("velocity")
                if (
                    channel.tag == "channel"
                    and drives
                    and (index is None or 0 <= index < self.rotors)
                ):
                    channels.append(channel)
        return channels

    def pose_of_link(self, link: Element) -> Pose:
        """Return where a link lies in the model's frame.

        Raises
        ------
        ExportError
            It counts from a frame that is no link and no frame of the model.
        """
        return self._placed(link, ())

    def pose_of_inertial(self, link: Element) -> Pose:
        """Return where a link's inertial frame lies in the model's frame."""
        inertial = link.find("inertial")
        return self.pose_of_link(link) @ (self._written(inertial) if inertial else IDENTITY)

    def inertial_of(self, link: Element) -> Inertial | None:
        """Return a link's mass and inertia in the model's frame; None for a link without."""
        inertial = link.find("inertial")
        if inertial is None:
            return None
        mass = self._number_in(inertial, "mass")
        if mass is None:
            raise ExportError(
                self.path,
                f"link '{link.attributes.get('name')}' has no mass that is a number",
                "write it as one",
            )
        tensor = inertial.find("inertia")
        entry = {
            axes: (self._number_in(tensor, axes) or 0.0) if tensor else 0.0
            for axes in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        }
        matrix = np.array(
            [
                [entry["ixx"], entry["ixy"], entry["ixz"]],
                [entry["ixy"], entry["iyy"], entry["iyz"]],
                [entry["ixz"], entry["iyz"], entry["izz"]],
            ]
        )
        return Inertial(mass, self.pose_of_inertial(link), matrix)

    def _written(self, element: Element) -> Pose:
        """Return an element's ``<pose>`` as it is written, in whatever frame it counts from."""
        pose = element.find("pose")
        words = content(pose, self.text).split() if pose else []
        if pose is None or not words:
            return IDENTITY
        if pose.attributes.get("rotation_format", "euler_rpy") != "euler_rpy":
            raise ExportError(
                self.path, "has a pose that is not in euler_rpy", "write it as x y z roll pitch yaw"
            )
        try:
            numbers = np.array([float(word) for word in words]).reshape(6)
        except ValueError:
            raise ExportError(
                self.path, f"has the pose '{' '.join(words)}'", "write six numbers"
            ) from None
        if pose.attributes.get("degrees", "false") == "true":
            numbers[3:] = np.deg2rad(numbers[3:])
        return pose_of(numbers.tolist())

    def _placed(self, element: Element, passed: tuple[str, ...]) -> Pose:
        pose = element.find("pose")
        named = pose.attributes.get("relative_to", "") if pose else ""
        frame = named or element.attributes.get("attached_to", "")
        if frame in {"", "__model__"}:
            within = next((at for member, at in self._members() if member is element), IDENTITY)
            return within @ self._written(element)
        return self._frame(frame, passed) @ self._written(element)

    def _frame(self, name: str, passed: tuple[str, ...]) -> Pose:
        for element, _ in self._members():
            same = element.attributes.get("name") == name
            if same and element.tag in {"link", "frame"} and name not in passed:
                return self._placed(element, (*passed, name))
        raise ExportError(
            self.path, f"has a pose relative to '{name}'", "give it relative to a link or frame"
        )

    def _number_in(self, element: Element, tag: str) -> float | None:
        child = element.find(tag)
        return None if child is None else number(child, self.text)


def _named(plugin: Element) -> str:
    """Return what a plugin is called, gz-sim's motor model by one name."""
    names = plugin.attributes.get("filename", "") + plugin.attributes.get("name", "")
    return names.replace("MulticopterMotorModel", _GZ_MOTOR)


def read_model(text: str, path: Path, rotors: int) -> Model:
    """Take a model file apart.

    Raises
    ------
    ExportError
        It holds no model, no link, or no motor plugin.
    """
    element = model_in(parse(text, path), path)
    links = [member for member, _ in _inside(element, IDENTITY) if member.tag == "link"]
    missing = [include for include in element.all("include") if include.attributes.get("merge")]
    if not links:
        remedy = "give the SDF of a multirotor"
        if missing:
            remedy = "put the folders of the models that it includes beside its own"
        raise ExportError(path, "has no <link>", remedy)
    model = Model(path, text, element, _base(element, links), rotors)
    if not model.motors():
        raise ExportError(
            path,
            "has no motor model plugin",
            "give a model for PX4's motor model plugins: where it is split over files, the one "
            "that includes the others",
        )
    return model


def _inside(parent: Element, frame: Pose) -> Iterator[tuple[Element, Pose]]:
    """Yield what an element holds, through what was merged into it, and the frame of each."""
    for child in parent.children:
        if child.tag == MERGED:
            numbers = [float(word) for word in child.attributes["at"].split()]
            yield from _inside(child, frame @ pose_of(numbers))
        else:
            yield child, frame


def _base(root: Element, links: list[Element]) -> Element:
    by_name = {link.attributes.get("name", ""): link for link in links}
    for name in (root.attributes.get("canonical_link", ""), "base_link"):
        if name in by_name:
            return by_name[name]
    return links[0]


def inertials(model: Model) -> Iterator[tuple[Element, Inertial]]:
    """Yield each link that has mass, with its inertial."""
    for link in model.links:
        inertial = model.inertial_of(link)
        if inertial is not None:
            yield link, inertial
