"""The command `stiffopt bench recordings`: compare methods on recordings of real arms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, Quiet, Units, command_group, option

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stiffopt.cli.tables import TextTable
    from stiffopt.identify.bench import BenchScore

bench_app = command_group(help="Measure methods on recordings of real arms.")

_EPILOG = """\
\b
Examples:
  stiffopt bench recordings ../shared/data
  stiffopt bench recordings data --splits my-arms.yaml --methods stiffopt,gaussian-process --json
\b
Exit codes:
  0    done
  2    bad input
  130  interrupted (Ctrl-C)
"""


@bench_app.callback()
def _bench() -> None:
    """Measure methods on recordings of real arms."""


@bench_app.command(
    "recordings", short_help="Fit methods to recordings, and compare them.", epilog=_EPILOG
)
@with_exit_code
def recordings(
    folder: Annotated[str, typer.Argument(metavar="DIR", show_default=False)],
    splits: Annotated[
        str | None, option("FILE.yaml", "Arms and their files; by default those of stiffopt.")
    ] = None,
    methods: Annotated[
        str | None,
        option(
            "LIST",
            "Any of stiffopt, constant-curvature, polynomial, gaussian-process, network; by "
            "default all. The last three need scikit-learn.",
        ),
    ] = None,
    rows: Annotated[int, option("N", "Fitted rows; by default 400.", min=50, max=10_000)] = 400,
    full: Annotated[
        bool, typer.Option("--full", help="stiffopt compares its models, which takes minutes.")
    ] = False,
    seed: Annotated[int, option("N", "Seed of the learnt methods.", min=0)] = 0,
    units: Units = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fit methods to some recordings of real arms, and measure how well they predict others.

    DIR is the folder of the recordings, which do not come with stiffopt. A file (--splits) states
    which of them are for training and which for testing. Rows are thinned, and stiffopt fits one
    model quickly unless --full is given.
    """
    from stiffopt.cli.console import show, write_json
    from stiffopt.cli.exits import interruptible_work
    from stiffopt.identify.bench import METHODS, load_bench, run_bench

    names = list(METHODS) if methods is None else [name.strip() for name in methods.split(",")]
    with interruptible_work(quiet=quiet) as progress:
        bench, base = load_bench(splits)
        found = list(
            run_bench(
                Path(folder), names, bench, base,
                rows=rows, full=full, seed=seed, progress=progress,
            )
        )  # fmt: skip
    if as_json:
        write_json(
            {"rows": rows, "full": full, "seed": seed, "scores": [_record(s) for s in found]}
        )
    elif not quiet:
        show(_table(found, rows).renderable())


def _table(found: Sequence[BenchScore], rows: int) -> TextTable:
    from stiffopt.cli.tables import TextTable
    from stiffopt.display import display_units

    unit = display_units().length

    def share(value: float, places: int = 0) -> str:
        return "-" if value != value else f"{value * 100:.{places}f} %"

    return TextTable(
        f"Error of the predicted tip in {unit}",
        ("arm", "method", "train", "test", "95 %", "of length", "coverage"),
        tuple(
            (
                each.arm, each.method, unit.number(each.train, ".2f"),
                *("-" if v != v else unit.number(v, ".2f") for v in (each.test, each.p95)),
                share(each.test / each.length, 1), share(each.coverage),
            )
            for each in found
        ),
        f"train, test: mean in what was fitted (to {rows} rows) and in other files; of length: the "
        "mean test error; coverage: of the 95 % region, in other files",
        words=("method",),
    )  # fmt: skip


def _record(score: BenchScore) -> dict[str, Any]:
    return {
        "arm": score.arm,
        "method": score.method,
        "length_m": score.length,
        "train_mean_error_m": score.train,
        "test_mean_error_m": score.test,
        "test_p95_error_m": score.p95,
        "test_error_percent_of_length": score.test / score.length * 100,
        "coverage_95": score.coverage,
        "test_rows": score.rows,
    }
