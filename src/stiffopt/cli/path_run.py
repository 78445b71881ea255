"""Run `stiffopt path`: solve path files in turn; print, write and draw the solutions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as FilePath

from stiffopt.cli import exits, path_records, quantities
from stiffopt.cli.batch import Batch
from stiffopt.cli.console import show, warnings_as_notes, write_json
from stiffopt.cli.exits import interruptible
from stiffopt.cli.outputs import check_writable
from stiffopt.cli.path_records import SolvedPath
from stiffopt.cli.solve_files import check_result_file, names_for_each, picture_names
from stiffopt.documents import write_file, write_whole
from stiffopt.errors import EquilibriumError, FileError, InputError
from stiffopt.model.manipulator import load_robot
from stiffopt.paths.motion_file import RESULT_FORMAT, is_motion_csv
from stiffopt.paths.path import load_path
from stiffopt.paths.solution import PathSolution


class PathBatch(Batch[SolvedPath]):
    """The path files of one command; the arguments are its options."""

    def __init__(
        self,
        as_json: bool,
        out: tuple[str, ...],
        plot: str | None,
        seed: int,
        quiet: bool,
        view: str | None = None,
    ) -> None:
        super().__init__(as_json, quiet, writes_files=bool(out) or plot is not None)
        self.out, self.plot, self.seed = out, plot, seed
        self.view = quantities.view(view)

    def run(self, files: Sequence[str]) -> int:
        """Solve path files; return the exit code."""
        for out in self.out:
            if is_csv(out):
                check_csv(out, files)
            else:
                check_result_file(out, files, RESULT_FORMAT)
        pictures = picture_names(self.plot, files)
        with interruptible() as check, warnings_as_notes(quiet=self.quiet):
            self.answer_all(files, pictures, check)
            self.summarise("path", "status", "points", "time s", "worst", "solved in s")
        for out in self.out:
            self.write(lambda out=out: self._write(out, files))  # type: ignore[misc]
        return self.exit_code

    def _write(self, out: str, files: Sequence[str]) -> None:
        if not is_csv(out):
            results = [path_records.result_record(each) for each in self.answers]
            write_file(out, {"format": RESULT_FORMAT, "results": results})
            return
        names = dict(zip(files, names_for_each(out, files), strict=True))
        for each in self.answers:
            write_whole(names[each.file], path_records.csv_text(each.solution).encode())

    def answer(self, file: str) -> SolvedPath:
        """See `Batch.answer`."""
        from stiffopt.paths.solver import solve_path

        path = load_path(file)
        try:
            robot = load_robot(path.resolve_robot())
            try:
                solution = solve_path(robot, path, seed=self.seed)
            except EquilibriumError as error:
                solution = PathSolution.without_answer("failed", str(error), robot, None)
            return SolvedPath(file, path, solution)
        except FileError:
            raise
        except InputError as error:
            raise FileError(file, str(error)) from None

    def take(self, answer: SolvedPath, seconds: float) -> None:
        """See `Batch.take`."""
        self.codes.append(exits.OF_STATUS[answer.solution.status])
        if self.as_json:
            self.print(lambda: write_json(path_records.json_record(answer)))
        elif not self.quiet:
            from stiffopt.cli.path_report import block, summary_row

            self.rows.append(summary_row(answer, seconds))
            self.print(lambda: show(block(answer)))

    def draw(self, answer: SolvedPath, picture: str) -> None:
        """See `Batch.draw`."""
        from stiffopt.plots import plot_path, save_figure

        title = FilePath(answer.file).stem
        figure = plot_path(answer.path, answer.solution, title=title, view=self.view)
        save_figure(figure, picture)

    def is_drawable(self, answer: SolvedPath) -> bool:
        """See `Batch.is_drawable`."""
        return len(answer.solution.times) > 0


def is_csv(out: str) -> bool:
    """Return whether a file name ends in .csv."""
    return out.lower().endswith(".csv")


def check_csv(out: str, files: Sequence[str]) -> None:
    """Check the paths of CSV files: only the output of an earlier command is overwritten."""
    for name in map(FilePath, names_for_each(out, files)):
        check_writable(str(name))
        if name.is_file() and name.stat().st_size and not is_motion_csv(name):
            raise FileError(name, "exists and is no CSV of a path's solution; give another name")
