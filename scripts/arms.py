"""Writes the MJCF of the UR family's other arms below assets/ur/: `make arms`.

Each is the UR5's model with the link lengths of its own Denavit–Hartenberg table, as conf/robot/ has it, its published
masses, torque limits and offsets of the links, and the UR5's shapes stretched to meet one another.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

from koopdqn.app.api import load_config
from koopdqn.robot.ur import URArm

ASSETS: Final = Path(__file__).resolve().parents[1] / "assets"
_LINKS: Final = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")


@dataclass(frozen=True)
class Shape:
    """What a DH table does not tell of an arm, from Universal Robots' ROS 2 description and data sheets.

    Attributes:
        masses: (6,) of the links from the shoulder on [kg].
        shoulder: from the base's axis to the upper arm's, sideways [m].
        elbow: the same to the forearm's [m].
        footprint: diameter of the base [m]; every radius is the UR5's in this proportion.
    """

    masses: tuple[float, ...]
    shoulder: float
    elbow: float
    footprint: float


UR5: Final = Shape((3.7, 8.393, 2.33, 1.219, 1.219, 0.1879), 0.1359, 0.017, 0.149)
SHAPES: Final = {
    "ur3": Shape((2.0, 3.42, 1.26, 0.8, 0.8, 0.35), 0.1198, 0.0275, 0.128),
    "ur10": Shape((7.1, 12.7, 4.27, 2.0, 2.0, 0.365), 0.220941, 0.049042, 0.190),
    "ur3e": Shape((1.98, 3.4445, 1.437, 0.871, 0.805, 0.261), 0.120, 0.027, 0.128),
    "ur5e": Shape((3.761, 8.058, 2.846, 1.37, 1.3, 0.365), 0.138, 0.007, 0.149),
    "ur10e": Shape((7.369, 13.051, 3.989, 2.1, 1.98, 0.615), 0.1762, 0.0393, 0.190),
    "ur16e": Shape((7.369, 10.45, 4.321, 2.18, 2.033, 0.907), 0.176, 0.040, 0.190),
}
Point = tuple[float, float, float]


def model_of(name: str) -> str:
    """Return the MJCF of an arm of :data:`SHAPES`."""
    arm, plain = _arm(name), _arm("ur5")
    tree = ElementTree.fromstring((ASSETS / plain.asset).read_text(encoding="utf-8"))
    tree.set("model", name)
    shape, girth = SHAPES[name], SHAPES[name].footprint / UR5.footprint
    maps = _maps(arm, plain, shape, girth)
    for body in tree.iter("body"):
        link = str(body.get("name"))
        for geom in body.findall("geom"):
            _reshape(geom, maps[link], girth)
        if link in _LINKS:
            place = _LINKS.index(link)
            ratio = shape.masses[place] / UR5.masses[place]
            stretch = {"upper_arm_link": arm.a2 / plain.a2, "forearm_link": arm.a3 / plain.a3}.get(link, girth)
            _load(body.find("inertial"), maps[link], shape.masses[place], ratio, girth, stretch)
    for link, at in {
        "shoulder_link": (0.0, 0.0, arm.d1),
        "forearm_link": (arm.a2, 0.0, 0.0),
        "wrist_1_link": (arm.a3, 0.0, arm.d4),
        "wrist_2_link": (0.0, -arm.d5, 0.0),
        "wrist_3_link": (0.0, arm.d6, 0.0),
    }.items():
        tree.find(f".//body[@name='{link}']").set("pos", _text(at))  # type: ignore[union-attr]  # it is there
    for actuator, torque, usual in zip(
        tree.findall("actuator/general"), arm.torque_limits, plain.torque_limits, strict=True
    ):
        # As stiff for its torque as the UR5's, and with the same lag.
        stiffness = 50.0 * round((400.0 if usual > 100.0 else 80.0) * torque / usual)
        actuator.set("gainprm", f"{stiffness:g}")
        actuator.set("biasprm", f"0 {-stiffness:g} {-0.02 * stiffness:g}")
        actuator.set("forcerange", f"{-torque:g} {torque:g}")
    ElementTree.indent(tree)
    head = f"<!-- {arm.name}. SPDX-License-Identifier: Apache-2.0. Made from the UR5's model by scripts/arms.py. -->\n"
    return head + ElementTree.tostring(tree, encoding="unicode") + "\n"


def _arm(name: str) -> URArm:
    arm = load_config(f"robot={name}").robot
    assert isinstance(arm, URArm)
    return arm


def _maps(arm: URArm, plain: URArm, shape: Shape, girth: float) -> dict[str, Callable[[Point], Point]]:
    """Return where a point of each of the UR5's links is on the other arm, in the link's frame [m].

    Across a link everything grows with the girth; along it so that it ends where the next link begins.
    """
    below = (arm.d1 - 0.024 * girth) / (plain.d1 - 0.024)
    aside = (shape.shoulder - (UR5.shoulder - 0.0707) * girth) / 0.0707
    inner = (shape.shoulder - (UR5.shoulder - 0.0707) * girth - shape.elbow) / (0.0707 - UR5.elbow)
    outer = (arm.d4 - 0.0455 * girth - shape.elbow) / (plain.d4 - 0.0455 - UR5.elbow)
    wrist_1 = (arm.d5 - 0.0459 * girth) / (plain.d5 - 0.0459)
    wrist_2 = (arm.d6 - 0.0345 * girth) / (plain.d6 - 0.0345)

    def even(point: Point) -> Point:
        x, y, z = point
        return girth * x, girth * y, girth * z

    def shoulder(point: Point) -> Point:
        x, y, z = point
        return girth * x, (aside if y < -0.01 else girth) * y, (below if z < 0.0 else girth) * z

    def upper_arm(point: Point) -> Point:
        x, y, z = point
        return arm.a2 / plain.a2 * x, girth * y, shape.shoulder + girth * (z - UR5.shoulder)

    def forearm(point: Point) -> Point:
        x, y, z = point
        above = inner if x > 0.5 * plain.a3 else outer
        return arm.a3 / plain.a3 * x, girth * y, shape.elbow + (above if z > UR5.elbow else girth) * (z - UR5.elbow)

    def first(point: Point) -> Point:
        x, y, z = point
        return girth * x, (wrist_1 if y < 0.0 else girth) * y, girth * z

    def second(point: Point) -> Point:
        x, y, z = point
        return girth * x, (wrist_2 if y > 0.0 else girth) * y, girth * z

    return {"base": even, **dict(zip(_LINKS, (shoulder, upper_arm, forearm, first, second, even), strict=True))}


def _reshape(geom: ElementTree.Element, mapped: Callable[[Point], Point], girth: float) -> None:
    for key in ("fromto", "pos"):
        if text := geom.get(key):
            numbers = [float(number) for number in text.split()]
            points = [mapped((x, y, z)) for x, y, z in zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True)]
            geom.set(key, " ".join(map(_text, points)))
    geom.set("size", " ".join(f"{girth * float(number):.6g}" for number in str(geom.get("size")).split()))


def _load(
    inertial: ElementTree.Element | None,
    mapped: Callable[[Point], Point],
    mass: float,
    ratio: float,
    girth: float,
    stretch: float,
) -> None:
    """Give a link its mass; its moments grow with the mass and the square of its sizes."""
    assert inertial is not None
    x, y, z = (float(number) for number in str(inertial.get("pos")).split())
    along, *across = (float(number) for number in str(inertial.get("diaginertia")).split())
    moments = [along * ratio * girth**2, *(moment * ratio * stretch**2 for moment in across)]
    inertial.set("pos", _text(mapped((x, y, z))))
    inertial.set("mass", f"{mass:g}")
    inertial.set("diaginertia", " ".join(f"{moment:.6g}" for moment in moments))


def _text(point: Point) -> str:
    return " ".join(f"{round(number, 6) + 0.0:.8g}" for number in point)


def main() -> int:
    """Write every model."""
    for name in SHAPES:
        (ASSETS / "ur" / f"{name}.xml").write_text(model_of(name), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
