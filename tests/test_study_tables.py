"""Tables of an experiment's results."""

import re
from collections.abc import Sequence
from typing import Any

import pytest
from experiment import Column, Experiment, Table
from experiment_parts import PAGE, experiment
from hypothesis import given
from hypothesis import strategies as st
from study_runs import Result
from study_tables import cell, signed, stated, table_text, with_tables

from koopdqn.errors import BadInputError

SUMMARY = {
    "labels": {"what": "about", "changed": "config", "undone": "undoes", "seeds": "seeds"},
    "columns": {
        "learned": {"value": "learned", "show": "true of all"},
        "success [%]": {"value": "success_rate", "kind": "percent", "show": "mean (least)"},
        "questions": {"value": "oracle_queries", "show": "median (most)"},
    },
}
APART = {
    "labels": {"undone": "undoes", "what": "about", "case": "case", "seeds": "seeds"},
    "beside": "default",
    "columns": {
        "learned": {"value": "learned", "show": "true of all"},
        "success [%]": {"value": "success_rate", "kind": "percent", "show": "mean (least to most)"},
        "deviation [mm]": {"value": "deviation_mm", "kind": "tenths"},
    },
}
COMPARED = {
    "labels": {"question": "about", "seeds": "seeds"},
    "comparisons": {"what it adds": ["default", "sign"], "not measured": ["default", "wide"]},
    "columns": {
        "success [points]": {"value": "success_rate", "kind": "percent", "better": "more"},
        "deviation [mm]": {"value": "deviation_mm", "kind": "tenths", "better": "less"},
        "questions": {"value": "oracle_queries"},
    },
}


def result(seed: int | None = 1, line: str = "default", case: str = "shelf", **values: Any) -> Result:
    known = {"learned": True, "success_rate": 1.0, "deviation_mm": 5.0, "oracle_queries": 10, "demonstrations": None}
    return Result(case, line, seed, {**known, **values})


def rows(table: dict[str, Any], results: Sequence[Result], cases: Sequence[str] = ("shelf",)) -> list[list[str]]:
    text = table_text(Table.model_validate(table), experiment(), results, cases)
    return [[text.strip() for text in line.strip("|").split("|")] for line in text.splitlines()]


def test_a_row_is_over_its_seeds_and_says_only_what_differs() -> None:
    others = [
        result(seed, success_rate=rate, oracle_queries=asked, learned=seed != 2)
        for seed, rate, asked in ((2, 0.5, 0), (3, 0.75, 400), (7, 0.75, 20))
    ]
    head, _, default, sign = rows(SUMMARY, [result(), *others, result(4, "sign")])
    assert head == ["what", "changed", "undone", "seeds", "learned", "success [%]", "questions"]
    assert default == ["the default", "", "–", "1–3, 7", "3 of 4", "75 (50)", "15 (400)"]
    assert sign == ["`reward.shape=sign`", "`reward.shape=sign`", "D5", "4", "1 of 1", "100", "10"]


def test_a_row_of_which_nothing_is_known_is_left_out_and_unknown_values_do_not_count() -> None:
    unknown: dict[str, Any] = dict.fromkeys(("learned", "success_rate", "oracle_queries"))
    _, _, *left = rows(SUMMARY, [result(), result(2, oracle_queries=None), result(1, "sign", **unknown)])
    assert [row[-3:] for row in left] == [["2 of 2", "100", "10"]]


def test_kept_results_have_no_seed() -> None:
    _, _, row = rows(SUMMARY, [result(None, oracle_queries=39487)])
    assert row[3:] == ["–", "1 of 1", "100", "39,487"]


def test_others_are_shown_less_the_default_with_the_same_seeds() -> None:
    of_case = [result(deviation_mm=18.5), result(2, success_rate=0.9, deviation_mm=18.5)]
    sign = [result(1, "sign", learned=False, deviation_mm=20.0), result(2, "sign", deviation_mm=20.0)]
    knife = [result(1, case="knife"), result(1, "sign", "knife"), result(3, "sign", "knife")]
    _, _, *found = rows(APART, [*of_case, *sign, *knife], ["shelf", "knife"])
    assert found == [
        ["–", "the default", "shelf", "1–2", "2 of 2", "95 (90 to 100)", "18.5"],
        ["", "", "knife", "1", "1 of 1", "100", "5.0"],
        ["D5", "`reward.shape=sign`", "shelf", "1–2", "1 of 2", "+5 (0 to +10)", "+1.5"],
        ["", "", "knife", "1", "1 of 1", "0", "0.0"],
    ]


def test_lines_are_compared_seed_by_seed() -> None:
    own = [result(seed, success_rate=rate) for seed, rate in ((1, 0.9), (2, 1.0), (3, 1.0))]
    beside = [
        result(seed, "sign", success_rate=0.8, deviation_mm=deviation) for seed, deviation in ((1, 6), (2, 4), (9, 50))
    ]
    head, _, *found = rows(COMPARED, [*own, *beside])
    assert head[-2:] == ["in every seed it adds", "in every seed it costs"]
    assert found == [["what it adds", "1–2", "+15 (+10 to +20)", "0.0 (−1.0 to +1.0)", "0", "success", "nothing"]]


def test_less_than_the_digit_shown_is_no_difference() -> None:
    [*_, found] = rows(COMPARED, [result(), result(1, "sign", deviation_mm=5.04)])
    assert found[-2:] == ["nothing", "nothing"]
    [*_, found] = rows(COMPARED, [result(), result(1, "sign", deviation_mm=4.0)])
    assert found[-2:] == ["nothing", "deviation"]


def titled(title: str) -> Experiment:
    return experiment(tables={"part": [{**SUMMARY, "title": title}, {**COMPARED, "title": "beside"}]})


def test_tables_stand_case_by_case_where_their_title_names_it() -> None:
    results = [result(), result(case="knife")]
    text = with_tables(PAGE, titled("### {case}"), results)
    assert re.findall(r"### \w+|beside", text) == ["### shelf", "beside", "### knife", "beside"]
    assert re.findall(r"all|beside", with_tables(PAGE, titled("all"), results)) == ["all", "beside"]


def test_the_rest_of_a_page_stays_and_a_second_time_nothing_changes() -> None:
    once = with_tables(PAGE, titled("all"), [result()])
    assert once.startswith("above\n")
    assert once.endswith("below\n")
    assert with_tables(once, titled("all"), [result()]) == once
    assert "Nothing is measured yet" in with_tables(once, titled("all"), [])


@pytest.mark.parametrize("page", ["", "<!-- begin: part -->\n", PAGE + PAGE])
def test_a_page_without_its_part_is_refused(page: str) -> None:
    with pytest.raises(BadInputError, match="part must stand in the text once"):
        with_tables(page, titled("all"), [result()])


@given(st.lists(st.floats(0, 1), min_size=1))
def test_the_least_success_is_never_above_the_mean(rates: list[float]) -> None:
    column = Column(value="success_rate", kind="percent", show="mean (least)")
    mean, _, least = (
        cell(column, [result(success_rate=rate) for rate in rates]).replace(",", "").rstrip(")").partition(" (")
    )
    assert float(least or mean) <= float(mean)


@given(st.floats(-1e6, 1e6))
def test_a_difference_has_the_sign_of_what_is_shown(value: float) -> None:
    text = signed(value, "tenths")
    assert float(text.replace("−", "-").replace(",", "")) == pytest.approx(value, abs=0.051)
    assert text[0] in "+−" or set(text) <= set("0.")


@given(st.lists(st.floats(0, 1e6), min_size=1))
def test_a_spread_keeps_the_mean_within_the_range(values: list[float]) -> None:
    text = stated(values, "mean (least to most)", "{:.1f}".format)
    numbers = [float(part) for part in re.split(r" \(| to ", text.replace(")", ""))]
    if len(numbers) == 3:
        mean, low, high = numbers
        assert low <= mean <= high
    else:
        assert max(values) - min(values) <= 0.1001


def test_of_no_values_nothing_is_stated() -> None:
    assert stated([], "mean (least)", str) == "–"
