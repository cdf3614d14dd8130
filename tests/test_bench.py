import pytest
from benchmarks.rows import NOT_INSTALLED, Row, compared, figure, installed, table


def row(
    ours: float | None = 2.0, theirs: float | str = 8.0, bar: float | None = None, least_ratio: float | None = None
) -> Row:
    return Row("a thing", ours, "ms", "a peer", theirs, bar, least_ratio)


def test_the_ratio_says_how_many_times_faster_ours_is() -> None:
    assert row(2.0, 8.0).ratio == 4.0
    assert row(8.0, 2.0).ratio == 0.25


@pytest.mark.parametrize(("ours", "theirs"), [(None, 8.0), (2.0, NOT_INSTALLED)])
def test_without_both_figures_there_is_no_ratio_and_its_bar_is_not_judged(
    ours: float | None, theirs: float | str
) -> None:
    found = row(ours, theirs, least_ratio=3.0)
    assert found.ratio is None
    assert found.met is None


def test_all_bars_of_a_row_must_be_met() -> None:
    assert row(bar=2.0, least_ratio=4.0).met is True
    assert row(bar=1.9, least_ratio=4.0).met is False
    assert row(bar=2.0, least_ratio=4.1).met is False
    assert row().met is None


def test_the_bar_of_our_own_figure_is_judged_without_a_peer() -> None:
    assert row(2.0, NOT_INSTALLED, bar=3.0, least_ratio=8.0).met is True


def test_a_missing_peer_keeps_its_row_in_the_table() -> None:
    (line,) = table([row(theirs=NOT_INSTALLED, bar=1.0)]).splitlines()[2:]
    assert line == "| a thing | 2 ms | a peer | not installed |  | ≤ 1 ms, missed |  |"


def test_a_row_left_out_says_so() -> None:
    (line,) = table([row(None, least_ratio=8.0)]).splitlines()[2:]
    assert line == "| a thing | not measured | a peer | 8 ms |  | ratio ≥ 8 |  |"


def test_every_row_has_as_many_cells_as_the_head() -> None:
    head, rule, *lines = table([row(), row(None), row(theirs=NOT_INSTALLED, bar=3.0)]).splitlines()
    assert {line.count("|") for line in (head, rule, *lines)} == {8}


def test_a_row_is_described_with_what_follows_from_it() -> None:
    described = row(bar=3.0).described()
    assert described["ratio"] == 4.0
    assert described["met"] is True
    assert described["unit"] == "ms"


def test_figures_have_three_digits() -> None:
    assert figure(12345.6, "µs") == "12300 µs"
    assert figure(0.00123456, "s") == "0.00123 s"


def test_both_pieces_of_work_are_done_in_turn() -> None:
    done: list[str] = []
    ours, theirs = compared(lambda: done.append("ours"), lambda: done.append("theirs"), repeats=2)
    assert theirs is not None
    assert min(ours, theirs) > 0
    order = [name for name, before in zip(done, ["", *done], strict=False) if name != before]
    assert order == ["ours", "theirs"] * 3


def test_alone_a_piece_of_work_has_no_second_time() -> None:
    assert compared(lambda: None, None, repeats=1)[1] is None


def test_what_cannot_be_imported_is_not_installed() -> None:
    assert installed("numpy")
    assert not installed("a_peer_that_nobody_has")
