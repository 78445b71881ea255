"""The studio in a real browser without a screen: what is dragged and pressed there, and seen."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from running import wait_for
from stiffopt import lie

pytest.importorskip("viser", reason="viser is missing: pip install 'stiffopt[studio]'")
playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is missing: pip install playwright"
)
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="there is no chromium: apt install chromium"
)

ROOT = Path(__file__).resolve().parent.parent
TASK = ROOT / "problems" / "two_segment_stiff_x.yaml"
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]  # fmt: skip
X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
PATIENCE = 50_000  # ms


@pytest.fixture
def browser_page() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, headless=True, args=SOFTWARE)
        page = browser.new_page(viewport={"width": 720, "height": 460})
        page.set_default_timeout(PATIENCE)
        yield page
        browser.close()


def on_screen(client: Any, point: Any) -> np.ndarray:
    """Return where a point in space is seen, in pixels."""
    camera = client.camera
    axes = np.asarray(lie.rotation_from_quaternion(np.asarray(camera.wxyz)))
    x, y, z = axes.T @ (np.asarray(point) - camera.position)
    focus = camera.image_height / 2 / np.tan(camera.fov / 2)
    return np.array(
        [camera.image_width / 2 + focus * x / z, camera.image_height / 2 + focus * y / z]
    )


def test_the_arm_follows_a_target_that_is_dragged(browser_page: Any, compiled: Path) -> None:
    from stiffopt.studio.opening import open_studio

    studio, page, mistakes = open_studio(str(TASK)), browser_page, []
    page.on("console", lambda said: mistakes.append(said.text) if said.type == "error" else None)
    try:
        page.goto(studio.url)
        page.wait_for_selector("text=1.445 N/m")
        assert page.url == f"http://127.0.0.1:{studio.page.port}/"  # the key is gone
        (client,) = studio.page.server.get_clients().values()
        view, bench = studio.view, studio.view.bench
        start = view.target_position

        page.wait_for_timeout(2500)  # until its handle is drawn; software renders slowly
        drag(page, client, start + X * 0.03, start + X * 0.045)  # its arrow along x

        wait_for(lambda: bench.answer.is_best and bench.answer.design == bench.design)
        target = np.asarray(bench.design.task.target.position)
        assert target[0] - start[0] == pytest.approx(0.015, abs=0.005)
        np.testing.assert_allclose(target[1:], start[1:], atol=1e-5)
        tip = bench.answer.solution.tip_pose[:3, 3]
        assert np.linalg.norm(tip - target) < 1.01e-4
        said = f"({', '.join(f'{1e3 * x + 0.0:.1f}' for x in tip)}) mm"
        page.wait_for_selector(f"text={said}")
        np.testing.assert_allclose(view.arm_end, tip, atol=1e-6)

        page.get_by_role("button", name="undo").click()
        page.wait_for_selector("text=1.445 N/m")
        page.get_by_role("tab", name="copy").click()
        page.get_by_role("button", name="copy as task file").click()
        copied = page.locator("textarea").input_value()
        assert copied.startswith("format: stiffopt-task/1")
        assert not mistakes
    finally:
        studio.close()


def drag(page: Any, client: Any, start: np.ndarray, end: np.ndarray) -> None:
    """Drag from one point in space to another, as a hand does: in steps."""
    grip, goal = on_screen(client, start), on_screen(client, end)
    page.mouse.move(*grip)
    page.wait_for_timeout(500)
    page.mouse.down()
    for share in np.linspace(0.1, 1.0, 10):
        page.mouse.move(*(grip + share * (goal - grip)))
        page.wait_for_timeout(60)
    page.mouse.up()


def test_direction_and_objects_are_dragged(browser_page: Any, compiled: Path) -> None:
    from stiffopt.studio.opening import open_studio

    studio, page = open_studio(str(TASK)), browser_page
    page.set_viewport_size({"width": 1200, "height": 460})  # the panel covers no handle
    try:
        page.goto(studio.url)
        page.wait_for_selector("text=1.445 N/m")
        (client,) = studio.page.server.get_clients().values()
        view, bench = studio.view, studio.view.bench

        handle = view.direction_position
        np.testing.assert_allclose(handle - view.arm_end, 0.045 * X, atol=1e-6)
        page.wait_for_timeout(2500)  # until its handle is drawn; software renders slowly
        drag(page, client, handle + 0.016 * Z, handle + 0.046 * Z)  # its arrow along z
        wait_for(lambda: bench.design.measure.direction[2] > 0)
        wait_for(lambda: bench.answer.is_best and bench.answer.design == bench.design)
        x, y, z = bench.design.measure.direction
        assert (x, y, z) == (pytest.approx(0.83, abs=0.1), 0.0, pytest.approx(0.55, abs=0.15))
        value = bench.answer.solution.stiffness
        page.wait_for_selector(f"text={value:#.4g} N/m")
        assert value > 1.5  # along the arm it is stiffer

        page.get_by_role("tab", name="scene").click()
        page.get_by_role("button", name="add an object").click()
        wait_for(lambda: len(bench.design.objects) == 1)
        page.wait_for_timeout(2500)  # until its handle is drawn; software renders slowly
        before = bench.design.objects[0].shape
        handle = view.object_position
        drag(page, client, handle + 0.025 * X, handle + 0.045 * X)
        wait_for(lambda: bench.design.objects[0].shape != before)
        moved = view.object_position - handle
        np.testing.assert_allclose(moved, 0.02 * X, atol=0.005)
        page.wait_for_selector("text=clearance")

        page.get_by_label("may be leant on").check()
        wait_for(lambda: bench.design.objects[0].contact is not None)
        page.get_by_label("lean: hold the pressures").check()
        page.wait_for_selector("text=drag an object that may be leant on")
        pressures = bench.answer.pressures
        for _ in range(8):  # towards the arm, until they touch
            handle = view.object_position
            drag(page, client, handle + 0.025 * X, handle + 0.010 * X)
            wait_for(lambda: bench.leaning is not None and bench.leaning.design == bench.design)
            if bench.leaning.equilibrium.contacts:
                break
        page.wait_for_selector("text=times the free arm's")
        page.wait_for_selector("text=on sphere 1")
        np.testing.assert_array_equal(bench.leaning.equilibrium.pressures, pressures)
        free, braced = bench.leaning.stiffness
        assert braced > free
        leaning = bench.leaning.equilibrium.tip_pose[:3, 3]
        wait_for(lambda: np.allclose(view.arm_end, leaning, atol=1e-6))
        page.get_by_label("lean: hold the pressures").uncheck()
        page.wait_for_selector("text=clearance")
    finally:
        studio.close()


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from stiffopt.cli.main import main

    monkeypatch.setattr("stiffopt.errors.find_spec", lambda name: None)
    assert main(["studio"]) == 2
    assert stiffopt.MissingExtraError("viser", "studio").extra == "studio"
