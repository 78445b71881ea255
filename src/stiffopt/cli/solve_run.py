"""Run `solve`: solve task files in turn; print, write and draw the solutions.

The module of the tables needs rich, and is imported only when one is printed.
"""

from __future__ import annotations

from collections.abc import Sequence

from stiffopt.cli import exits, quantities, solve_files, solve_records
from stiffopt.cli.batch import Batch
from stiffopt.cli.console import report_error, report_note, show, warnings_as_notes, write_json
from stiffopt.cli.exits import interruptible
from stiffopt.cli.solved_task import SolvedTask, solve_file
from stiffopt.display import display_units
from stiffopt.errors import InputError, shown


class TaskBatch(Batch[SolvedTask]):
    """The task files of one command; the arguments are its options."""

    def __init__(
        self,
        as_json: bool,
        out: str | None,
        plot: str | None,
        pareto: int | None,
        seed: int,
        quiet: bool,
        view: str | None = None,
        suggest_post: str | None = None,
        post_force: str | None = None,
    ) -> None:
        written = (out, plot, suggest_post)
        super().__init__(as_json, quiet, writes_files=any(each is not None for each in written))
        self.suggest_post = suggest_post
        self.post_force = _largest_force(suggest_post, post_force)
        self.out, self.plot, self.pareto, self.seed = out, plot, pareto, seed
        self.view = quantities.view(view)

    def run(self, tasks: Sequence[str]) -> int:
        """Solve task files and folders of them; return the exit code."""
        found = solve_files.find_tasks(tasks)
        out, files = self.out, found.paths
        if out is not None:
            solve_files.check_result_file(out, files)
        pictures = solve_files.picture_names(self.plot, files)
        self.maps = dict(
            zip(files, solve_files.picture_names(self.suggest_post, files), strict=True)
        )
        with interruptible() as check, warnings_as_notes(quiet=self.quiet):
            for bad in found.errors:
                self.refuse(bad.path, str(bad))
            for note in found.skipped if not self.quiet else ():
                report_note(note)
            self.answer_all(files, pictures, check)
            units = display_units()
            errors = f"error {units.length}", units.angle.name
            self.summarise("task", "status", *errors, "stiffness", "gain", "time s")
        if out is not None:
            self.write(lambda: solve_files.write_results(out, self.answers))
        return self.exit_code

    def answer(self, file: str) -> SolvedTask:
        """See `Batch.answer`."""
        return solve_file(file, seed=self.seed, pareto=self.pareto, post_force=self.post_force)

    def take(self, answer: SolvedTask, seconds: float) -> None:
        """See `Batch.take`."""
        self.codes.append(exits.OF_STATUS[answer.solution.status])
        if self.as_json:
            self.print(lambda: write_json(solve_records.json_record(answer)))
        elif not self.quiet:
            from stiffopt.cli.solve_report import block, summary_row

            self.rows.append(summary_row(answer, seconds))
            self.print(lambda: show(block(answer)))
        for failed in filter(None, (answer.no_front, answer.no_supports)):
            report_error(f"{answer.file}: {failed}")
            self.codes.append(exits.BAD_INPUT)
        if answer.supports is not None:
            solve_files.draw_supports(answer, self.maps[answer.file], self.view)

    def draw(self, answer: SolvedTask, picture: str) -> None:
        """See `Batch.draw`."""
        solve_files.draw(answer, picture, self.view)

    def is_drawable(self, answer: SolvedTask) -> bool:
        """See `Batch.is_drawable`."""
        return answer.solution.pressures is not None


def _largest_force(suggest_post: str | None, post_force: str | None) -> float | None:
    """Return the largest force on a new post or wall, in N; None if none is to be suggested."""
    if suggest_post is None:
        if post_force is not None:
            raise InputError("--post-force: needs --suggest-post FILE.png, whose post it is for")
        return None
    given = "0.3 N" if post_force is None else post_force
    force = quantities.quantity("--post-force", given, "N", "force")
    if not force > 0:
        raise InputError(f"--post-force: must be greater than 0, not {shown(post_force)}")
    return force
