from importlib import import_module

import pytest

from koopdqn.app.command_table import COMMANDS
from koopdqn.app.hydra.compose import composed


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_names_a_function_and_keys_that_exist(name: str) -> None:
    what = COMMANDS[name]
    module, _, function = what.function.partition(".")
    assert callable(getattr(import_module(f"koopdqn.app.commands.{module}"), function))
    own = (*what.own_keys, *(what.flag or ())[:1])
    assert set(own) <= set(composed([]).get(name, ()))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_run_is_looked_at_or_gone_on_with_and_only_examples_of_the_command_are_shown(name: str) -> None:
    what = COMMANDS[name]
    assert not (what.looks_at and what.goes_on_with)
    assert all(example.startswith(f"koopdqn {name}") for example in what.examples)
