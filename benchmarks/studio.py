"""Measure the studio's response time to a drag, and the cost of its drawing.

    python benchmarks/studio.py [TASK ...] [--changes N] [--no-browser]

Moves the target of a task round a circle, 30 times a second, while a headless browser shows the
page. In ms: `wall`, median and 95th percentile of the time from a change until its solution is
drawn, which means little on a busy computer; `cpu`, the 95th percentile of the CPU time for it. Per
solution, as the mean over 20 changes, smallest of all such means: `search`, of the solver;
`drawing`, of picture and panel; `sending`, the rest of the server process. `found` is the share of
reachable targets.
"""

import argparse
import os
import shutil
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from stiffopt.studio.opening import open_studio

PROBLEMS = Path(__file__).parent.parent / "problems"
TASKS = ("two_segment_stiff_x", "two_segment_past_a_rib", "three_segment_stiff_y",
         "hanging_retraction")  # fmt: skip
GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PERIOD = 1 / 30  # s
COLUMNS = ("wall", "p95", "cpu p95", "search", "drawing", "sending", "answers", "found")


def measured(task: str, changes: int, radius: float, browser: Any) -> list[float]:
    """The numbers of a task, as `COLUMNS` has them, for a circle with a radius in m."""
    studio = open_studio(task)
    view = studio.view
    bench, worker = view.bench, view.worker
    searches: list[float] = []
    answers: list[float] = []
    found: list[bool] = []

    def timed(work: Any, times: list[float]) -> Any:
        def call(cancel: Any) -> Any:
            begin = time.thread_time()
            result = work(cancel)
            times.append(time.thread_time() - begin)
            return result

        return call

    with ExitStack() as stack:
        stack.callback(studio.close)
        if browser is not None:
            page = browser.new_page()
            stack.callback(page.close)
            page.goto(studio.url)
        while bench.answer is None or not bench.answer.is_best:
            time.sleep(0.1)
        time.sleep(2.0)
        bench.answer_quickly = timed(bench.answer_quickly, searches)
        worker._quickly = timed(worker._quickly, answers)
        worker._fully = lambda _: None  # of a hand that pauses
        middle = view.target_position
        handled, spent = [], []
        for number in range(-30, changes):  # the first of them warm up
            if number == 0:
                for each in (worker.delays, searches, answers, handled):
                    each.clear()
            if number >= 0 and number % 20 == 0:
                cpu = sum(searches), sum(answers), sum(cpu for _, cpu in handled)
                spent.append((time.process_time(), *cpu, len(answers)))
            angle = 2 * np.pi * number / 120
            way = np.array([np.sin(angle), 1 - np.cos(angle), 0.0])
            begin, cpu = time.perf_counter(), time.thread_time()
            view._target.position = middle + radius * way
            with suppress(StopIteration):
                view._target_moved(SimpleNamespace(target=view._target, phase="update")).send(None)
            handled.append((time.perf_counter() - begin, time.thread_time() - cpu))
            time.sleep(max(0.0, PERIOD - (time.perf_counter() - begin)))
            found.append(bench.answer.design == bench.design and bench.answer.solution.found)
        process, search, answer, handling, count = np.diff(spent, axis=0).T
        parts = np.array([search, answer - search + handling, process - answer - handling])
        wall, cpu = np.median(handled, axis=0)
        times = [*np.percentile(worker.delays, [50, 95]) + wall, np.percentile(answers, 95) + cpu,
                 *(parts / np.maximum(count, 1)).min(axis=1)]  # fmt: skip
    return [1e3 * each for each in times] + [len(answers), float(np.mean(found[-changes:]))]


def main() -> None:
    """Measure, and print a line for each task and circle."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=[str(PROBLEMS / f"{t}.yaml") for t in TASKS])
    parser.add_argument("--changes", type=int, default=300)
    parser.add_argument("--no-browser", action="store_true")
    given = parser.parse_args()
    os.environ.setdefault("STIFFOPT_COMPILE", "wait")
    print(f"{'task, radius of the circle':36}" + "".join(f"{name:>9}" for name in COLUMNS))
    with ExitStack() as stack:
        browser, program = None, shutil.which("chromium")
        if program is not None and not given.no_browser:
            from playwright.sync_api import sync_playwright

            started = stack.enter_context(sync_playwright())
            browser = started.chromium.launch(executable_path=program, args=GL)
        for task in given.tasks:
            for radius in (0.015, 0.06):
                numbers = measured(task, given.changes, radius, browser)
                name = f"{Path(task).stem}, {1e3 * radius:.0f} mm"
                print(f"{name:36}" + "".join(f"{x:9.2f}" for x in numbers), flush=True)


if __name__ == "__main__":
    main()
