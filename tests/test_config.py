import importlib
import math
import string
import sys
import textwrap
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from pydantic import ValidationError, model_validator

from koopdqn import resources
from koopdqn import settings as settings_module
from koopdqn.app.hydra import application
from koopdqn.app.hydra.completion import complete
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.folder import require_new, require_writable
from koopdqn.app.hydra.overrides import going_on, literal, prepare
from koopdqn.errors import BadInputError
from koopdqn.settings import Count, Counts, Fraction, PathText, Positive, Settings, Vector3, load_settings, validate

HERE = __name__


@runtime_checkable
class HasStep(Protocol):
    step_m: float


class Inner(Settings):
    gain: Positive = 1.0


class Task(Settings):
    step_m: Positive
    corner_m: Vector3 = (0.0, 0.0, 0.0)
    steps: Count = 5
    widths: Counts = (8,)
    share: Fraction = 0.5
    kind: Literal["left", "right"] = "left"
    file: PathText | None = None
    inner: Inner = Inner()

    @model_validator(mode="after")
    def _check(self) -> "Task":
        if self.steps > 100 * self.step_m:
            raise ValueError(f"steps must be at most 100 step_m, found {self.steps} with step_m {self.step_m}")
        return self


class Other(Settings):
    colour: str = "red"


class Worker(Settings, ABC):
    @abstractmethod
    def work(self) -> None: ...

    @abstractmethod
    def rest(self) -> None: ...


class Restless(Worker):
    def work(self) -> None: ...


class NotSettings:
    step_m = 1.0


def message_of(node: object, where: str = "task") -> str:
    with pytest.raises(BadInputError) as caught:
        validate(node, Task, where)  # type: ignore[arg-type]  # wrong types are the point
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ({"step_m": -0.1}, "task.step_m: must be greater than 0, found -0.1"),
        ({"step_m": math.nan}, "task.step_m: must be a finite number, found nan"),
        ({"step_m": math.inf}, "task.step_m: must be a finite number, found inf"),
        ({"step_m": "fast"}, "task.step_m: must be a number, found 'fast'"),
        ({"step_m": True}, "task.step_m: must be a number, found True"),
        ({"step_m": None}, "task.step_m: must be a number, found None"),
        ({"step_m": 1, "steps": ""}, "task.steps: must be a whole number, found ''"),
        ({"step_m": 1, "steps": 2.0}, "task.steps: must be a whole number, found 2.0"),
        ({"step_m": 1, "corner_m": [1, 2]}, "task.corner_m: must be a list of 3 numbers, found [1, 2]"),
        ({"step_m": 1, "corner_m": 7}, "task.corner_m: must be a list of 3 numbers, found 7"),
        ({"step_m": 1, "corner_m": [1, 2, "x"]}, "task.corner_m[2]: must be a number, found 'x'"),
        ({"step_m": 1, "widths": [4, 0]}, "task.widths[1]: must be greater than or equal to 1, found 0"),
        ({"step_m": 1, "share": 1.5}, "task.share: must be less than or equal to 1, found 1.5"),
        ({"step_m": 1, "kind": "up"}, "task.kind: must be 'left' or 'right', found 'up'"),
        ({"step_m": 1, "file": " "}, "task.file: must be a path, found ' '"),
        ({"step_m": 1, "inner": {"gian": 2}}, "unknown key task.inner.gian; valid: gain"),
        ({"step_m": 1, "inner": {"gain": 0}}, "task.inner.gain: must be greater than 0, found 0"),
        ({"step_m": 1, "inner": 4}, "task.inner: must be a group of keys, found 4"),
        ({"step_m": 0.01, "steps": 9}, "task: steps must be at most 100 step_m, found 9 with step_m 0.01"),
        ({}, "task.step_m: must be given, found nothing"),
        (None, "task: must be a group of keys, found None"),
        ([1], "task: must be a group of keys, found [1]"),
    ],
)
def test_a_bad_value_is_told_by_key_rule_and_value(node: object, expected: str) -> None:
    assert message_of(node) == expected


def test_an_unknown_key_lists_the_valid_ones_and_comes_before_what_it_leaves_missing() -> None:
    text = message_of({"step": 1})
    assert text.startswith("unknown key task.step; valid: corner_m, file, inner, kind, share, step_m")
    assert text.endswith("(and 1 more)")


def test_several_errors_are_counted() -> None:
    assert message_of({"step_m": -1, "steps": 0, "share": 2}).endswith("found -1 (and 2 more)")


def test_open_and_broken_references_name_their_key() -> None:
    config = OmegaConf.create({"task": {"step_m": "???"}, "other": {"step_m": "${nowhere}"}})
    assert message_of(config.task) == "task.step_m: must be given, found ??? (nothing)"
    assert message_of(config.other, "other") == "other.step_m: Interpolation key 'nowhere' not found"


def test_the_root_of_a_config_has_no_prefix() -> None:
    assert message_of({"step_m": 0}, "").startswith("step_m: must be")


def test_long_values_are_cut() -> None:
    assert len(message_of({"step_m": "x" * 10_000})) < 150


def test_settings_cannot_be_changed() -> None:
    settings = validate({"step_m": 1.0}, Task)
    with pytest.raises(ValidationError):
        settings.steps = 4  # type: ignore[misc]  # frozen: that is what is tested


@given(st.floats(min_value=0.06, max_value=1e6), st.lists(st.floats(-9, 9), min_size=3, max_size=3))
def test_good_values_arrive_unchanged(step: float, corner: list[float]) -> None:
    settings = validate(OmegaConf.create({"step_m": step, "corner_m": corner}), Task)
    assert (settings.step_m, settings.corner_m) == (step, tuple(corner))


_ANY = st.none() | st.booleans() | st.floats() | st.text() | st.lists(st.integers())


@given(
    st.fixed_dictionaries({}, optional=dict.fromkeys(Task.model_fields, _ANY))
    | st.dictionaries(st.text(max_size=6), _ANY)
)
def test_whatever_is_given_the_answer_is_settings_or_one_line(node: dict[str, object]) -> None:
    try:
        answer: object = validate(node, Task, "task")
    except BadInputError as error:
        answer = str(error)
    assert isinstance(answer, Task) or (isinstance(answer, str) and 0 < len(answer.splitlines()) < 2)


class TestTarget:
    def test_names_the_class_and_the_rest_fills_it(self) -> None:
        loaded = load_settings(OmegaConf.create({"target": f"{HERE}.Task", "step_m": 1.0}), Task, "task")
        assert loaded == Task(step_m=1.0)

    def test_may_implement_a_protocol(self) -> None:
        loaded: HasStep = load_settings({"target": f"{HERE}.Task", "step_m": 1.0}, HasStep, "task")
        assert loaded.step_m == 1.0

    def test_may_live_in_the_users_own_package(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "my_lab.py").write_text(f"from {HERE} import Task\nclass Mine(Task):\n    extra: int = 3\n")
        monkeypatch.syspath_prepend(tmp_path)
        loaded = load_settings({"target": "my_lab.Mine", "step_m": 1.0, "extra": 4}, Task, "task")
        assert loaded.model_dump()["extra"] == 4

    @pytest.mark.parametrize(
        ("target", "expected"),
        [
            ("no_such_module_here.Task", "(ModuleNotFoundError: No module named 'no_such_module_here')"),
            (f"{HERE}.Tsk", "has no class 'Tsk'; valid: HasStep, Inner, NotSettings, Other, Restless, Task"),
            ("Task", "must be a dotted name such as some.module.Class, found 'Task'"),
            (3, "must be a dotted name such as some.module.Class, found 3"),
            ("", "must be a dotted name such as some.module.Class, found ''"),
            (f"{HERE}.Other", f"must name a class that implements {HERE}.Task, found {HERE}.Other"),
        ],
    )
    def test_a_wrong_one_is_explained(self, target: object, expected: str) -> None:
        with pytest.raises(BadInputError, match=r"^task\.target: ") as caught:
            load_settings({"target": target}, Task, "task")
        assert expected in str(caught.value)

    def test_a_class_that_breaks_its_protocol_or_is_no_settings_is_refused(self) -> None:
        for name in ("Other", "NotSettings"):
            with pytest.raises(BadInputError, match=f"task.target: .*found {HERE}.{name}"):
                load_settings({"target": f"{HERE}.{name}"}, HasStep, "task")

    def test_what_a_class_lacks_is_named(self) -> None:
        with pytest.raises(BadInputError, match=rf"implements {HERE}.Worker, found {HERE}.Restless without rest$"):
            load_settings({"target": f"{HERE}.Restless", "pay": 1}, Worker, "task")
        with pytest.raises(BadInputError, match=rf"implements {HERE}.HasStep, found {HERE}.Other without step_m$"):
            load_settings({"target": f"{HERE}.Other"}, HasStep, "task")

    def test_an_absent_one_and_a_module_that_fails_are_explained(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with pytest.raises(BadInputError, match=r"task\.target: must name a class .*, found nothing"):
            load_settings({"step_m": 1.0}, Task, "task")
        with pytest.raises(BadInputError, match=r"found nothing \(_target_ is written target here\)$"):
            load_settings({"_target_": f"{HERE}.Task", "step_m": 1.0}, Task, "task")
        (tmp_path / "broken_lab.py").write_text("1 / 0\n")
        monkeypatch.syspath_prepend(tmp_path)
        with pytest.raises(BadInputError, match="ZeroDivisionError: division by zero"):
            load_settings({"target": "broken_lab.Mine"}, Task, "task")


class TestResources:
    def test_a_packages_own_folder_comes_before_the_checkouts(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        package, checkout = tmp_path / "package", tmp_path / "checkout"
        monkeypatch.setattr(resources, "roots", lambda: (package, checkout))
        with pytest.raises(BadInputError, match="conf/ is not installed"):
            resources.conf_dir()
        for root in (checkout, package):
            (root / "conf").mkdir(parents=True)
            (root / "conf" / "config.yaml").touch()
            assert resources.conf_dir() == root / "conf"

    def test_an_unknown_asset_lists_its_neighbours(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "assets" / "arm").mkdir(parents=True)
        (tmp_path / "assets" / "arm" / "arm.xml").touch()
        monkeypatch.setattr(resources, "roots", lambda: (tmp_path,))
        assert resources.asset_path("arm/arm.xml").is_file()
        with pytest.raises(BadInputError, match=r"unknown asset 'arm/am\.xml'; valid: arm/arm\.xml"):
            resources.asset_path("arm/am.xml")


class TestOverrides:
    @pytest.mark.parametrize("value", ["runs/x/intent.npz", "intent.npz", "./a", "m.safetensors"])
    def test_intent_that_looks_like_a_path_is_a_file(self, value: str) -> None:
        assert prepare("train", [f"intent={value}"]).overrides == [f"intent_file={value}", "command=train"]

    def test_intent_that_is_a_file_is_a_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        assert prepare("train", ["intent=paper"]).overrides[0] == "intent=paper"
        Path("paper").touch()
        assert prepare("train", ["intent=paper"]).overrides[0] == "intent_file=paper"

    @given(st.text(string.ascii_letters + " ()[]{}#='\\@%:~+-.", min_size=1))
    def test_a_path_with_characters_of_hydras_grammar_arrives_whole(self, name: str) -> None:
        from hydra.core.override_parser.overrides_parser import OverridesParser

        override = prepare("fit", [f"demos=dir/{name}"]).overrides[0]
        assert OverridesParser.create().parse_override(override).value() == f"dir/{name}"

    @pytest.mark.parametrize("override", ["seed", "=3", "", "+", "--sed"])
    def test_what_is_no_override_is_refused(self, override: str) -> None:
        with pytest.raises(BadInputError, match=r"an override must read key=value \(such as task=shelf\), found"):
            prepare("train", [override])

    def test_the_command_cannot_be_overridden(self) -> None:
        with pytest.raises(BadInputError, match="command: is set by the subcommand"):
            prepare("train", ["++command=fit"])

    def test_continuing_puts_the_recorded_overrides_first(self, tmp_path: Path) -> None:
        record(tmp_path, ["task=knife", "seed=4", "out=elsewhere", "command=train"])
        prepared = prepare("train", [f"run={tmp_path}", "seed=5", "agent.episodes=9"])
        assert prepared.record is not None
        assert prepared.overrides == [
            "task=knife",
            f"run={tmp_path}",
            "seed=5",
            "agent.episodes=9",
            "command=train",
            f"out={tmp_path}",
            f"hydra.run.dir={tmp_path}",
            "hydra.output_subdir=null",
        ]

    @pytest.mark.parametrize("name", ["a,b", "it's", "${seed}", "1e3"])
    def test_a_run_in_a_folder_of_any_name_is_found(self, name: str, tmp_path: Path) -> None:
        from hydra.core.override_parser.overrides_parser import OverridesParser

        folder = tmp_path / name
        folder.mkdir()
        record(folder, ["task=knife", "command=train"])
        given = f"run={literal(str(folder))}"
        keys = ("run", "out", "hydra.run.dir")
        for command, asked in (("train", [given]), ("eval", [given]), ("compare", [given, given])):
            found = OverridesParser.create().parse_overrides(prepare(command, asked).overrides)
            assert {each.value() for each in found if each.key_or_group in keys} == {str(folder)}
            assert not any(each.is_sweep_override() for each in found)

    def test_another_arm_comes_without_the_numbers_of_the_recorded_one(self, tmp_path: Path) -> None:
        record(tmp_path, ["robot=mjcf", "robot.path=/elsewhere/arm.xml", "robot.site=flange", "command=train"])
        found = prepare("eval", [f"run={tmp_path}", "robot=ur5e"]).overrides
        assert [each for each in found if each.startswith("robot")] == ["robot=ur5e"]
        with pytest.raises(BadInputError, match=r"give robot\.path= again"):
            prepare("eval", [f"run={tmp_path}", "robot=mjcf"])

    def test_what_a_record_may_not_name_is_asked_for_by_a_key_that_can_be_given(self, tmp_path: Path) -> None:
        obstacle = "{name:m,shape:mesh,center_m:[-0.6,-0.6,0.1],file:/elsewhere/m.stl}"
        record(tmp_path, [f"task.obstacles=[{obstacle}]", "command=train"])
        with pytest.raises(
            BadInputError, match=r"task\.obstacles\.file is never taken .*; give task\.obstacles= again"
        ):
            prepare("eval", [f"run={tmp_path}"])

    def test_folders_that_are_compared_may_begin_at_home(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("HOME", str(tmp_path))
        record(tmp_path, ["command=train"])
        assert f"compare.runs=['{tmp_path}','{tmp_path}']" in prepare("compare", ["run=~", "run=~/"]).overrides

    def test_another_oracle_goes_on_without_the_settings_of_the_first(self, tmp_path: Path) -> None:
        record(tmp_path, ["oracle=terminal", "oracle.teacher=anna", "seed=4", "command=train"])
        found = prepare("train", [f"run={tmp_path}", "oracle=scripted"]).overrides
        assert found[:3] == ["seed=4", f"run={tmp_path}", "oracle=scripted"]
        same = prepare("train", [f"run={tmp_path}", "oracle.teacher=bert"]).overrides
        assert same[:4] == ["oracle=terminal", "seed=4", f"run={tmp_path}", "oracle.teacher=bert"]

    def test_the_command_that_goes_on_says_again_what_a_record_may_not(self, tmp_path: Path) -> None:
        folder = tmp_path / "a run"
        folder.mkdir()
        own = ["robot=mjcf", "robot.path='my arm.xml'", "oracle=custom", "oracle.target=mine.Up", "demos=a.csv"]
        record(folder, [*own, "task=knife", f"out={folder}", "command=train"])
        (folder / "demos.hdf5").touch()
        given = ["robot.path='my arm.xml'", "trust_modules=[mine]"]
        assert going_on("train", folder) == ["train", f"run={folder}", *given]
        prepared = prepare("train", going_on("train", folder)[1:])
        assert prepared.record == [*own[:1], *own[2:], "task=knife", f"out={folder}", "command=train", *given]

    def test_the_command_that_goes_on_is_told_without_a_record_too(self, tmp_path: Path) -> None:
        assert going_on("train", tmp_path) == ["train", f"run={tmp_path}"]

    def test_a_journal_is_named_in_short_or_in_full(self) -> None:
        for name in ("journal", "oracle.journal"):
            found = prepare("train", ["oracle=replay", f"{name}=a folder/feedback.jsonl"]).overrides
            assert found[1] == "oracle.journal='a folder/feedback.jsonl'"

    def test_eval_takes_the_overrides_of_the_run_it_measures(self, tmp_path: Path) -> None:
        record(tmp_path, ["task=knife", "out=here", "demos=x.hdf5", "command=train"])
        found = prepare("eval", [f"run={tmp_path}", "seed=1"])
        assert found.overrides == ["task=knife", "seed=1", f"run={tmp_path}", "command=eval"]
        assert found.record is None

    def test_a_run_that_cannot_be_continued_is_explained(self, tmp_path: Path) -> None:
        def refusal(*overrides: str, multirun: bool = False) -> str:
            with pytest.raises(BadInputError) as caught:
                prepare("train", overrides, multirun=multirun)
            return str(caught.value)

        assert "found ''" in refusal("run=")
        assert "found no folder" in refusal(f"run={tmp_path}/absent")
        assert "found no .hydra/overrides.yaml" in refusal(f"run={tmp_path}")
        record(tmp_path, ["command=fit"])
        assert "must name a run of 'train', found one of 'fit'" in refusal(f"run={tmp_path}")
        (tmp_path / ".hydra" / "overrides.yaml").write_text("[")
        assert "cannot be read" in refusal(f"run={tmp_path}")
        (tmp_path / ".hydra" / "overrides.yaml").write_text("a: 1")
        assert "must be a list of at most" in refusal(f"run={tmp_path}")
        record(tmp_path, ["command=train"])
        assert "--multirun" in refusal(f"run={tmp_path}", multirun=True)
        assert "out= cannot be given" in refusal(f"run={tmp_path}", "out=x")


class TestFolder:
    def test_new_empty_and_hidden_only_folders_are_free(self, tmp_path: Path) -> None:
        require_new(tmp_path / "absent")
        (tmp_path / ".hydra").mkdir()
        (tmp_path / "train.log").touch()
        require_new(tmp_path, ignore="train.log")
        with pytest.raises(BadInputError, match=r"must name a new or an empty folder, .* which holds train\.log$"):
            require_new(tmp_path)

    def test_how_to_go_on_with_what_was_begun_there_is_told(self, tmp_path: Path) -> None:
        folder = tmp_path / "größe mit leer"
        folder.mkdir()
        (folder / "begun.json").touch()
        with pytest.raises(BadInputError, match=r"; koopdqn train run='.*größe mit leer' goes on with it$"):
            require_new(folder)

    def test_a_file_in_the_way_is_told(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        for path in (tmp_path / "file", tmp_path / "file" / "below"):
            with pytest.raises(BadInputError, match="out: must name a folder that can be written, found"):
                require_writable(path)


class TestCompletion:
    def test_groups_options_and_keys(self, toy_conf: Path) -> None:
        assert complete([], "task") == ["task=knife", "task=shelf"]
        assert complete([], "task=s") == ["task=shelf"]
        assert complete([], "+task=s") == ["+task=shelf"]
        assert "seed=0" in complete([], "")
        assert complete([], "task.st") == ["task.step_m=0.0021"]
        assert complete(["task=knife"], "task.bl") == ["task.blade_m=0.2"]

    def test_bashs_split_words_are_understood(self, toy_conf: Path) -> None:
        assert complete(["task"], "") == ["knife", "shelf"]
        assert complete(["seed", "=", "3", "task", "="], "s") == ["shelf"]
        assert complete(["task", "=", "knife"], "task.bl") == ["task.blade_m=0.2"]

    def test_the_users_own_options_and_files_are_offered(
        self, toy_conf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "mine" / "task").mkdir(parents=True)
        (tmp_path / "mine" / "task" / "sword.yaml").write_text("name: sword\n")
        assert complete([], "task=s", str(tmp_path / "mine")) == ["task=shelf", "task=sword"]
        monkeypatch.chdir(tmp_path)
        for key in ("run", "waypoints", "sweep", "journal", "obstacles", "video", "correct.waypoints"):
            assert complete([], f"{key}=mi") == [f"{key}=mine/"]
        assert complete([], "demos=mi") == ["demos=mine/"]
        assert complete([], "demos=mine/t") == ["demos=mine/task/"]

    # Nothing changes the small config between examples; the whole one takes ten times as long to compose.
    @settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(words=st.lists(st.text(max_size=4), max_size=2), incomplete=st.text(max_size=5))
    def test_nothing_raises(self, toy_conf: Path, words: list[str], incomplete: str) -> None:
        assert isinstance(complete(words, incomplete, "/no/such/folder"), list)

    @pytest.mark.parametrize("incomplete", ["", "=", "task.", "\0", "${", "[", "demos=/no/such"])
    def test_nothing_raises_with_the_whole_config(self, incomplete: str) -> None:
        assert isinstance(complete(["x", "=", "seed=${"], incomplete, "/no/such/folder"), list)


def record(folder: Path, overrides: list[str]) -> None:
    (folder / ".hydra").mkdir(exist_ok=True)
    OmegaConf.save(OmegaConf.create(overrides), folder / ".hydra" / "overrides.yaml")


@pytest.fixture
def toy_conf(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    root = tmp_path_factory.mktemp("toy")
    (root / "conf" / "task").mkdir(parents=True)
    (root / "conf" / "config.yaml").write_text(
        textwrap.dedent("""\
        defaults: [_self_, task: shelf]
        seed: 0
        demos: null
        """)
    )
    (root / "conf" / "task" / "shelf.yaml").write_text("name: shelf\nstep_m: 0.0021\n")
    (root / "conf" / "task" / "knife.yaml").write_text("name: knife\nblade_m: 0.2\n")
    monkeypatch.setattr(resources, "roots", lambda: (root,))
    return root / "conf"


def test_importing_the_package_loads_nothing_heavy() -> None:
    import subprocess

    code = "import koopdqn, koopdqn.app.cli, sys; print([m for m in sys.argv[1:] if m in sys.modules])"
    heavy = ["torch", "mujoco", "scipy", "hydra", "omegaconf", "pydantic", "numpy"]
    done = subprocess.run([sys.executable, "-c", code, *heavy], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("old", sorted(settings_module._MOVED))
def test_classes_named_where_they_were_are_found(old: str) -> None:
    new = importlib.import_module(settings_module._MOVED[old])
    names = [name for name, value in vars(new).items() if isinstance(value, type) and value.__module__ == new.__name__]
    found = {name for name in names if issubclass(getattr(new, name), Settings)}
    assert found
    for name in found:
        assert settings_module._locate(f"{old}.{name}", "oracle") is getattr(new, name)


def test_a_list_longer_than_a_name_may_be_is_a_list() -> None:
    files = [f"recording_{index:04d}.csv" for index in range(40)]
    assert (
        f"demos=[{','.join(files)}]" in prepare("train", ["task=demonstrated", f"demos=[{','.join(files)}]"]).overrides
    )
    assert prepare("inspect", [f"import.columns={{{','.join(f'x{i}: column_{i}' for i in range(40))}}}"]).overrides


@pytest.mark.parametrize("name", ["we ird,[x]", "a=b", "1e3", "it's"])
def test_a_run_goes_on_whatever_its_folder_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name / ".hydra").mkdir(parents=True)
    record(tmp_path / name, ["task=shelf", "command=train"])
    tree = composed(prepare("train", [f"run={name}"]).overrides)
    assert (tree["run"], tree["out"]) == (name, name)


@pytest.mark.parametrize(("launcher", "here"), [("ray", True), ("submitit_slurm", True), ("joblib", False)])
def test_outcomes_of_jobs_on_other_machines_lie_where_these_see_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launcher: str, here: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[Path] = []
    monkeypatch.setattr(application, "_call_hydra", lambda job, *_, **__: seen.append(job.outcomes))
    told = ["-m", f"hydra/launcher={launcher}"]
    assert application.run("train", [], told, lambda *_: None, as_json=False, record=None) == 0  # type: ignore[arg-type]
    assert (seen[0].parent == tmp_path) == here
    assert list(tmp_path.iterdir()) == []
