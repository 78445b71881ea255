"""Progress of long commands: a bar on a terminal, lines with an estimate elsewhere."""

from __future__ import annotations

import pytest

from stiffopt.cli.console import ProgressBar


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    monkeypatch.delenv("STIFFOPT_PROGRESS")
    return Clock()


def test_lines_come_after_two_seconds_and_ever_more_seldom(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    times = []
    with ProgressBar(quiet=False, clock=clock) as bar:
        for second in range(200):
            clock.now = 100.0 + second
            bar.report(second, 200, "working")
            if capsys.readouterr().err:
                times.append(second)
    assert times == [2, 4, 8, 16, 32, 62, 92, 122, 152, 182]


def test_a_line_estimates_what_is_left(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(quiet=False, clock=clock) as bar:
        bar.report(0, 4, "reading")
        clock.now += 10
        bar.report(1, 4, "fitting\tall")
        clock.now += 20
        bar.report(2, None, "")
    out, err = capsys.readouterr()
    assert err.splitlines() == [
        r"fitting\tall: 25%, 10 s so far, about 30 s left",
        "30 s so far",
    ]
    assert out == ""


@pytest.mark.parametrize("quiet", [True, False])
def test_none_where_it_is_not_wanted(
    quiet: bool,
    clock: Clock,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if not quiet:
        monkeypatch.setenv("STIFFOPT_PROGRESS", "none")
    with ProgressBar(quiet=quiet, clock=clock) as bar:
        clock.now += 60
        bar.report(1, 2, "working")
    assert capsys.readouterr() == ("", "")
