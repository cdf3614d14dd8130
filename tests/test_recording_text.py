"""Text of many loggers is the same motion; what it does not say is asked for by name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import (
    ANGLES,
    HZ,
    POSES,
    QUATERNION,
    ROWS,
    TIMES,
    VECTOR,
    XYZW,
    declared,
    joined,
    numbered,
    poses_in,
    same,
    written,
)

from koopdqn import pose
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.names import parsed
from koopdqn.demonstrations.recordings.recording import NOTHING
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

P = POSES[:, :3]
NS = 1.68e18 + 1e9 * TIMES
FRANKA = np.zeros((ROWS, 16))
FRANKA[:, [0, 1, 2, 4, 5, 6, 8, 9, 10]] = pose.to_matrix(QUATERNION).transpose(0, 2, 1).reshape(ROWS, 9)
FRANKA[:, 12:15], FRANKA[:, 15] = P, 1.0
OTHER = FRANKA + 0.0
OTHER[:, 12] += 0.1

ROLES = ["x", "y", "z", "qx", "qy", "qz", "qw", "t"]
FIELDS = [*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw")]

SAID: dict[str, tuple[str, tuple[Array, ...], dict[str, Any]]] = {
    "rtde": (
        joined(
            [
                "timestamp",
                numbered("target_TCP_pose", 6),
                numbered("actual_TCP_pose", 6),
                numbered("actual_TCP_speed", 6),
            ]
        ),
        (TIMES, P + 0.3, VECTOR, P, VECTOR, P, VECTOR),
        {},
    ),
    "tum": ("# timestamp tx ty tz qx qy qz qw", (1.6e9 + TIMES, P, XYZW), {}),
    "rostopic": (
        joined(
            ["%time", *(f"field.pose.position.{a}" for a in "xyz"), *(f"field.pose.orientation.{a}" for a in "xyzw")]
        ),
        (NS, P, XYZW),
        {},
    ),
    "prefixed": (
        "Time current_pos_x current_pos_y current_pos_z current_quat_x current_quat_y current_quat_z current_quat_w",
        (TIMES, P, XYZW),
        {},
    ),
    "capitals": ("T X Y Z QW QX QY QZ extra", (TIMES, P, QUATERNION, TIMES), {}),
    "camel": ("timeStamp posX posY posZ quatW quatX quatY quatZ", (TIMES, P, QUATERNION), {}),
    "units named": (
        "time_ms x_mm y_mm z_mm roll_deg pitch_deg yaw_deg",
        (1e3 * TIMES, 1e3 * P, np.degrees(ANGLES)),
        {},
    ),
    "xarm": (
        "timestamp x y z roll pitch yaw",
        (1.7e9 + TIMES, 1e3 * P, np.degrees(ANGLES)),
        {"units": "mm", "angles": "deg"},
    ),
    "euler vectors": (
        "t pos.x pos.y pos.z rx ry rz",
        (TIMES, P, np.degrees(ANGLES)),
        {"rotation": "angles", "angles": "deg"},
    ),
    "kortex": (
        joined(["time", *(f"tool_pose_{a}" for a in "xyz"), *(f"tool_pose_theta_{a}" for a in "xyz")]),
        (TIMES, P, np.degrees(ANGLES)),
        {"angles": "deg"},
    ),
    "kuka": ("Time X Y Z A B C", (TIMES, 1e3 * P, np.degrees(ANGLES[:, ::-1])), {"units": "mm"}),
    "franka": (joined([numbered("O_T_EE", 16), numbered("O_T_EE_d", 16)]), (FRANKA, OTHER), {"rate_hz": HZ}),
    "two poses": (
        "x y z q0 q1 q2 q3 x y z q0 q1 q2 q3",
        (P + 0.1, QUATERNION, P, QUATERNION),
        {"pose": "2", "quaternion": "wxyz", "rate_hz": HZ},
    ),
    "by name": (
        "a b c d e f g clock",
        (P, XYZW, 1e3 * TIMES),
        {
            "columns": dict(zip(["x", "y", "z", "qx", "qy", "qz", "qw", "t"], [*"abcdefg", "clock"], strict=True)),
            "clock": "ms",
        },
    ),
    "stamps in two": (
        "stamp.secs stamp.nsecs x y z qw qx qy qz",
        (1.6e9 + np.floor(TIMES), np.rint(1e9 * (TIMES % 1.0)), P, QUATERNION),
        {},
    ),
}


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
@pytest.mark.parametrize("name", SAID)
def test_every_logger_says_the_same(tmp_path: Path, name: str, delimiter: str) -> None:
    header, columns, fields = SAID[name]
    path = written(tmp_path / "log.txt", header, *columns, delimiter=delimiter)
    if header.startswith("#"):
        path.write_text(path.read_text().replace("#" + delimiter, "# ", 1))
    (item,) = load(path, declared(fields), None).items
    same(item.poses, POSES, 1e-5)
    np.testing.assert_allclose(item.times - item.times[0], TIMES, atol=2e-6)


@pytest.mark.parametrize("units", ["m", "cm", "mm"])
def test_a_decimal_comma_and_no_header(tmp_path: Path, units: str) -> None:
    scale = {"m": 1.0, "cm": 100.0, "mm": 1000.0}[units]
    path = written(tmp_path / "log.txt", None, TIMES, scale * P, XYZW, delimiter=";")
    path.write_text(path.read_text().replace(".", ","))
    fields: dict[str, Any] = {"quaternion": "xyzw", **({} if units == "m" else {"units": units})}
    (found,) = poses_in(path, **fields)
    same(found, POSES, 1e-5)


def test_why_degrees_were_taken_is_told(tmp_path: Path) -> None:
    for name, header in (("as KUKA writes A B C", "A B C"), ("as a name says", "A_deg B_deg C_deg")):
        path = written(tmp_path / "log.csv", f"t x y z {header}", TIMES, P, np.degrees(ANGLES[:, ::-1]))
        assert any(each.endswith(f"in deg, {name}") for each in load(path, NOTHING, None).reasons)


def test_a_unit_is_the_files_and_not_a_demonstrations(tmp_path: Path) -> None:
    count = len(TIMES)
    angles = np.degrees(ANGLES[:, ::-1])
    both = np.concatenate([angles, angles / 100.0])
    number = np.repeat([0.0, 1.0], count)
    given = number, np.tile(TIMES, 2), np.tile(P, (2, 1)), both
    items = load(written(tmp_path / "log.csv", "demo t x y z A B C", *given), NOTHING, None).items
    turns = [pose.rotation_distance(pose.IDENTITY, item.poses[0]) for item in items]
    expected = [pose.from_roll_pitch_yaw(np.radians(each[0, ::-1])) for each in (angles, angles / 100.0)]
    wanted = [pose.rotation_distance(pose.IDENTITY, pose.make(np.zeros(3), each)) for each in expected]
    np.testing.assert_allclose(turns, wanted, atol=1e-5)


def test_declared_order_of_columns(tmp_path: Path) -> None:
    path = written(tmp_path / "log.dat", None, TIMES, QUATERNION, P, TIMES)
    (found,) = poses_in(path, columns=["t", "qw", "qx", "qy", "qz", "x", "y", "z", "_"])
    same(found, POSES)


@pytest.mark.parametrize(
    ("header", "columns", "keys"),
    [
        ("x y z q0 q1 q2 q3", (P, XYZW), ("import.quaternion", "import.rate_hz")),
        ("t x y z qw qx qy qz", (TIMES, 100 * P, QUATERNION), ("import.units", "too far in metres")),
        ("t tx ty tz qw qx qy qz", (TIMES, 100 * P, QUATERNION), ("import.units",)),
        ("t pos_x pos_y pos_z roll pitch yaw", (TIMES, P, np.degrees(ANGLES)), ("import.angles",)),
        ("t X Y Z A B C", (TIMES, P, ANGLES[:, ::-1]), ("import.angles", "as KUKA writes A B C in deg")),
        ("t pos_x pos_y pos_z rx ry rz", (TIMES, P, np.degrees(ANGLES)), ("import.rotation",)),
        ("t pos_x pos_y pos_z rot_x rot_y rot_z", (TIMES, P, VECTOR), ("import.rotation",)),
        ("t pos_x pos_y pos_z", (TIMES, P), ("import.orientation",)),
        ("t x y z tilt pan spin", (TIMES, P, ANGLES), ("import.orientation", "import.columns", "tilt, pan, spin")),
        ("n pos_x pos_y pos_z qw qx qy qz", (TIMES, P, QUATERNION), ("import.rate_hz", "import.speed_m_s")),
        ("time pos_x pos_y pos_z qw qx qy qz", (1e3 * TIMES, P, QUATERNION), ("import.clock",)),
        ("t a.x a.y a.z a.qw a.qx a.qy a.qz b.x b.y b.z b.qw b.qx b.qy b.qz", (TIMES, POSES, POSES), ("import.pose",)),
        ("t alpha beta gamma", (TIMES, P), ("import.columns",)),
        (None, (P, VECTOR), ("import.columns",)),
    ],
)
def test_what_a_file_does_not_say_is_asked_for_by_name(
    tmp_path: Path, header: str | None, columns: tuple[np.ndarray, ...], keys: tuple[str, ...]
) -> None:
    path = written(tmp_path / "log.csv", header, *columns)
    with pytest.raises(BadInputError) as caught:
        poses_in(path)
    assert all(key in str(caught.value) for key in keys), caught.value


@pytest.mark.parametrize(("clock", "seconds"), [("s", 1.0), ("ms", 0.001)])
def test_whole_ticks_are_what_is_declared(tmp_path: Path, clock: str, seconds: float) -> None:
    path = written(tmp_path / "log.csv", "t x y z qw qx qy qz", HZ * TIMES, P, QUATERNION)
    (item,) = load(path, declared({"clock": clock}), None).items
    np.testing.assert_allclose(item.times, seconds * np.arange(ROWS))


def test_path_length_as_the_clock(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", "x y z qw qx qy qz", P, np.tile(QUATERNION[:1], (ROWS, 1)))
    (item,) = load(path, declared({"speed_m_s": 0.1}), None).items
    speed = np.linalg.norm(np.diff(item.poses[:, :3], axis=0), axis=1) / np.diff(item.times)
    np.testing.assert_allclose(speed, 0.1, rtol=1e-4)


def test_repeated_times_are_left_out_and_told(tmp_path: Path) -> None:
    rows = np.repeat(np.arange(ROWS), np.where(np.arange(ROWS) % 5 == 0, 2, 1))
    path = written(tmp_path / "log.csv", "timestamp tx ty tz qw qx qy qz", TIMES[rows], POSES[rows])
    loaded = load(path, declared({}), None)
    same(loaded.items[0].poses, POSES)
    assert any(f"{ROWS // 5} rows that repeat" in reason for reason in loaded.reasons)


def test_a_tool_and_a_base_are_undone(tmp_path: Path) -> None:
    tool = pose.make([0.0, 0.02, 0.15], pose.from_rotation_vector([0.1, 0.0, 0.3]))
    base = pose.make([1.0, -0.5, 0.8], pose.from_rotation_vector([0.0, 0.0, 1.2]))
    seen = pose.compose(np.broadcast_to(base, POSES.shape), pose.compose(POSES, np.broadcast_to(tool, POSES.shape)))
    path = written(tmp_path / "log.csv", "timestamp tx ty tz qw qx qy qz", TIMES, seen)
    (found,) = poses_in(path, tool=[0.0, 0.02, 0.15, 0.1, 0.0, 0.3], base=[1.0, -0.5, 0.8, 0.0, 0.0, 1.2])
    same(found, POSES, 1e-5)


def test_demonstrations_are_told_apart(tmp_path: Path) -> None:
    label = np.repeat([3.0, 1.0], ROWS // 2)
    path = written(tmp_path / "log.csv", "episode_index timestamp tx ty tz qw qx qy qz", label, TIMES, POSES)
    first, second = poses_in(path)
    same(first, POSES[: ROWS // 2])
    same(second, POSES[ROWS // 2 :])


@pytest.mark.parametrize("odd", ["1_0", "nan", "", "0x10", "1e999", "one"])
def test_a_cell_that_is_no_number_is_named(tmp_path: Path, odd: str) -> None:
    path = written(tmp_path / "log.csv", "time tx ty tz qw qx qy qz", TIMES, POSES)
    lines = path.read_text().splitlines()
    lines[7] = ",".join([*lines[7].split(",")[:2], odd, *lines[7].split(",")[3:]])
    path.write_text("\n".join(lines))
    with pytest.raises(BadInputError, match="line 8: ty must be a finite number"):
        poses_in(path)


def test_a_decimal_comma_in_quotes_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", "time tx ty tz qw qx qy qz", TIMES, POSES)
    lines = path.read_text().splitlines()
    path.write_text(
        "\n".join(
            [lines[0], *(",".join(f'"{cell.replace(".", ",")}"' for cell in line.split(",")) for line in lines[1:])]
        )
    )
    with pytest.raises(BadInputError, match=r"line 2: .* must be a finite number, found '"):
        poses_in(path)


def test_a_last_line_cut_off_is_left_out_and_told(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", "time tx ty tz qw qx qy qz", TIMES, POSES)
    path.write_text(path.read_text()[:-30])
    loaded = load(path, declared({}), None)
    same(loaded.items[0].poses, POSES[:-1])
    assert f"line {ROWS + 1}, the last, cut off and left out" in loaded.reasons[0]
    path.write_text("\n".join(path.read_text().splitlines()[:2]) + "\n0.02,0.1,")
    with pytest.raises(BadInputError, match="line 3: must have 8 cells as the header, found 3"):
        poses_in(path)


@pytest.mark.parametrize(
    ("names", "other"),
    [("rx ry rz", VECTOR), ("roll pitch yaw", np.degrees(ANGLES)), ("rot_x rot_y rot_z rot_w", XYZW)],
)
def test_of_two_orientations_that_differ_one_is_read_and_told(tmp_path: Path, names: str, other: Array) -> None:
    header = f"t x y z qw qx qy qz {names}"
    for order, told in ((1, False), (-1, True)):
        path = written(tmp_path / f"{order}.csv", header, TIMES, POSES, other[::order])
        read = load(path, NOTHING, None)
        if not told:
            same(read.items[0].poses, POSES)
        assert any("apart, and the first is read" in reason for reason in read.reasons) is told


def test_what_holds_for_all_demonstrations_is_told_once_with_the_largest(tmp_path: Path) -> None:
    def told(*scales: float) -> list[str]:
        rows = [(np.full(ROWS, scale), TIMES, scale * P, QUATERNION, scale * VECTOR) for scale in scales]
        columns = [np.concatenate(each) for each in zip(*rows, strict=True)]
        path = written(tmp_path / "log.csv", "demo t x y z qw qx qy qz rx ry rz", *columns)
        return [each for each in load(path, NOTHING, None).reasons if "largest" in each or "apart" in each]

    (largest, _), (_, apart) = told(0.9), told(0.5)
    assert told(0.7, 0.5, 0.9) == [largest, apart]


WORD = st.from_regex(r"[a-z]{2,6}", fullmatch=True)


@given(st.lists(WORD, max_size=3), st.sampled_from("xyzw"), st.sampled_from("._-/"), st.sampled_from(["", "mm", "deg"]))
def test_a_name_is_the_same_in_any_case_and_with_any_separator(
    words: list[str], axis: str, sign: str, unit: str
) -> None:
    name = sign.join([*words, axis]) + (f" [{unit}]" if unit else "")
    assert parsed(name) == parsed(name.upper()) == parsed(name.replace(sign, "_"))
    assert parsed(name).unit == unit


@pytest.mark.parametrize(("first", "second", "named"), [("A", "B", "aA"), ("armA", "armB", ["arm_a", "armA", "arm_A"])])
def test_a_pose_is_named_in_any_case(tmp_path: Path, first: str, second: str, named: Sequence[str]) -> None:
    names = " ".join(f"{arm}_{axis}" for arm in (first, second) for axis in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    path = written(tmp_path / "log.csv", f"t {names}", TIMES, POSES, POSES[::-1])
    for name in named:
        (found,) = poses_in(path, pose=name)
        same(found, POSES)


@given(st.permutations(range(8)), st.sampled_from([",", ";", "\t"]))
def test_the_order_of_columns_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], sign: str
) -> None:
    names = np.array(["time", "tool_x", "tool_y", "tool_z", "tool_qw", "tool_qx", "tool_qy", "tool_qz"])
    values = np.column_stack([TIMES, POSES])[:5]
    path = written(
        tmp_path_factory.mktemp("order") / "log.csv", " ".join(names[order]), values[:, order], delimiter=sign
    )
    (found,) = poses_in(path)
    same(found, POSES[:5])


def test_a_tool_offset_that_changes_is_undone_row_by_row(tmp_path: Path) -> None:
    offset = np.zeros((ROWS, 6))
    offset[:, 2] = np.where(np.arange(ROWS) < ROWS // 2, 0.1, 0.2)
    tools = pose.make(offset[:, :3], pose.from_rotation_vector(offset[:, 3:]))
    points = pose.compose(POSES, tools)
    names = "timestamp " + " ".join(f"{kind}_{i}" for kind in ("actual_TCP_pose", "tcp_offset") for i in range(6))
    columns = (TIMES, points[:, :3], pose.to_rotation_vector(points[:, 3:]), offset)
    loaded = load(written(tmp_path / "log.csv", names, *columns), declared({}), None)
    same(loaded.items[0].poses, POSES)
    assert any("tcp_offset, which changes on the way" in each for each in loaded.reasons)


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [("header.stamp.sec", "header.stamp.nanosec"), ("sec", "nanosec"), ("stamp.secs", "stamp.nsecs"), ("sec", "nsec")],
)
def test_seconds_and_nanoseconds_are_one_clock(tmp_path: Path, seconds: str, nanoseconds: str) -> None:
    whole = 1_700_000_000 + np.floor(TIMES)
    names = f"{seconds} {nanoseconds} x y z qw qx qy qz"
    path = written(tmp_path / "log.csv", names, whole, np.round(1e9 * (TIMES % 1.0)), POSES)
    np.testing.assert_allclose(load(path, declared({}), None).items[0].times, TIMES, atol=1e-6)


def test_declarations_without_effect_are_told(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", "t x y z qw qx qy qz", TIMES, POSES)
    given = {"quaternion": "xyzw", "rotation": "vector", "orientation": [1, 0, 0, 0]}
    loaded = load(path, declared(given), None)
    same(loaded.items[0].poses, POSES)
    for key in given:
        assert any(f"import.{key} without effect" in each for each in loaded.reasons), key


def test_two_clocks_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"must not both be given, found 50 and 0\.1"):
        declared({"rate_hz": 50, "speed_m_s": 0.1})


def test_a_position_in_two_units_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "log.csv", None, TIMES, POSES)
    path.write_text("t,x [m],y [mm],z [mm],qw,qx,qy,qz\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(BadInputError, match="in one unit, found x in m, y in mm, z in mm"):
        load(path, declared({}), None)


@pytest.mark.parametrize(
    "pair", ["duration.sec duration.nanosec", "lifetime.secs lifetime.nsecs", "goal.sec goal.nsec"]
)
def test_a_span_or_another_time_is_not_the_clock(tmp_path: Path, pair: str) -> None:
    zero = np.zeros(ROWS)
    path = written(tmp_path / "log.csv", f"{pair} t x y z qw qx qy qz", zero, zero, TIMES, POSES)
    np.testing.assert_allclose(load(path, declared({}), None).items[0].times, TIMES, atol=1e-6)


def test_the_measured_stamp_comes_before_a_commanded_one_and_a_declared_clock_before_all(tmp_path: Path) -> None:
    zero, whole, rest = np.zeros(ROWS), 1_700_000_000 + np.floor(TIMES), np.round(1e9 * (TIMES % 1.0))
    stamps = "goal.header.stamp.sec goal.header.stamp.nanosec header.stamp.sec header.stamp.nanosec"
    path = written(tmp_path / "log.csv", f"{stamps} k x y z qw qx qy qz", zero, zero, whole, rest, 2 * TIMES, POSES)
    np.testing.assert_allclose(load(path, declared({}), None).items[0].times, TIMES, atol=1e-6)
    found = load(path, declared({"columns": {"t": "k"}}), None).items[0].times
    np.testing.assert_allclose(found, 2 * TIMES, atol=1e-6)


def test_a_declared_column_keeps_the_unit_of_its_name(tmp_path: Path) -> None:
    names = "time_ms px_mm py_mm pz_mm qw qx qy qz"
    path = written(tmp_path / "log.csv", names, 1000 * TIMES, 1000 * POSES[:, :3], POSES[:, 3:])
    roles = {
        "t": "time_ms",
        "x": "px_mm",
        "y": "py_mm",
        "z": "pz_mm",
        **{name: name for name in ("qw", "qx", "qy", "qz")},
    }
    item = load(path, declared({"columns": roles}), None).items[0]
    np.testing.assert_allclose(item.times - item.times[0], TIMES - TIMES[0], atol=1e-6)
    same(item.poses, POSES)
    small = 0.05 * np.sin(np.linspace(0.0, 2.0, ROWS))
    turned = pose.from_rotation_vector(np.column_stack([small, 0 * small, 0 * small]))
    angles = np.column_stack([np.degrees(small), 0 * small, 0 * small])
    path = written(tmp_path / "deg.csv", "t x y z roll_deg pitch_deg yaw_deg", TIMES, POSES[:, :3], angles)
    roles = {"roll": "roll_deg", "pitch": "pitch_deg", "yaw": "yaw_deg"}
    same(load(path, declared({"columns": roles}), None).items[0].poses, pose.make(POSES[:, :3], turned))


@pytest.mark.parametrize("other", ["t", "t_ms", "t [s]"])
def test_a_declared_clock_comes_before_one_of_its_name(tmp_path: Path, other: str) -> None:
    names = f"{other.replace(' ', '')} k x y z qw qx qy qz"
    path = written(tmp_path / "log.csv", names, 3 * TIMES, TIMES, POSES)
    np.testing.assert_allclose(load(path, declared({"columns": {"t": "k"}}), None).items[0].times, TIMES, atol=1e-6)


def test_units_of_a_pose_that_is_not_read_may_be_mixed(tmp_path: Path) -> None:
    names = "t x y z qw qx qy qz target_x_mm target_y_mm target_z_m"
    path = written(tmp_path / "log.csv", names, TIMES, POSES, POSES[:, :3])
    same(load(path, declared({}), None).items[0].poses, POSES)


def test_whole_seconds_are_taken_for_seconds_where_they_may_be(tmp_path: Path) -> None:
    def ticking(count: int) -> Path:
        rows = np.column_stack([np.arange(float(count)), np.resize(POSES, (count, 7))])
        return written(tmp_path / f"{count}.csv", "t x y z qw qx qy qz", rows)

    assert load(ticking(60), NOTHING, None).items[0].times[-1] == 59.0
    with pytest.raises(BadInputError, match=r"import\.clock: .* for 799 s"):
        load(ticking(800), NOTHING, None)
