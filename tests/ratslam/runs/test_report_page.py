"""The report in a real browser: opened from a file, used by mouse, checked by axe."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.artifacts.run_reader import read_closure_table, read_closure_views
from evaluation.report.run_report import view_records
from ratslam.cli import main
from ratslam.runs.map_results import write_report
from tests.helpers.commands import ROOT, copy_square_run

axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="of the extra [dev]")
playwright = pytest.importorskip("playwright.sync_api", reason="of the extra [dev]")

CHROMIUM = shutil.which("chromium")
HOSTILE = "<script>alert(1)</script>"
DRAWN = "[...document.querySelectorAll('.chart')].every((each) => each.querySelector('.main-svg .legend'))"
CLOSURES = 70
"""Closures kept in the run under test: more than a page of its table."""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH")


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with closures and truth, all but some of its closures removed, and hostile names: of the run, its
    source, its files, and the columns of its evidence."""
    path = copy_square_run(tmp_path_factory.mktemp("square") / "<img src=x onerror=alert(2)>")
    lines = (path / "closures.csv").read_text().replace("log_odds", "<u>odds<u>").splitlines(keepends=True)
    verdicts = [line.replace("accepted", "open") if k % 3 == 0 else line for k, line in enumerate(lines)]
    (path / "closures.csv").write_text("".join(verdicts[: CLOSURES + 1]))
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["recording"]["name"] = f"</script>{HOSTILE}"
    manifest["versions"]["<b>jax</b>"] = HOSTILE
    (path / "manifest.json").write_text(json.dumps(manifest))
    (path / "<i>note<i>").write_text("")
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield program
        program.close()


@pytest.fixture
def visit(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Opens the report of some runs; it logs nothing, opens no dialog and asks for nothing but itself."""
    faults: list[str] = []

    def watch(route: Any) -> None:
        url = route.request.url
        if route.request.is_navigation_request() and url.startswith("file:"):
            route.continue_()
        else:
            faults.extend([] if url.startswith(("data:", "blob:")) else [url])
            route.abort()

    def dismiss(dialog: Any) -> None:
        faults.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    def open_page(directories: list[Path], scheme: str = "light") -> Any:
        write_report(directories, tmp_path / "report.html")
        context = browser.new_context(color_scheme=scheme, viewport={"width": 1280, "height": 1000})
        context.route("**", watch)
        page = context.new_page()
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("dialog", dismiss)
        page.goto((tmp_path / "report.html").as_uri())
        page.evaluate("dispatchEvent(new Event('beforeprint'))")  # draws the charts out of view too
        page.wait_for_function(DRAWN)
        return page

    yield open_page
    assert faults == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_shows_its_runs_and_axe_finds_no_serious_fault(scheme, square, visit) -> None:
    arena, config = square.with_name("arena"), str(ROOT / "configs" / "create_arena.yaml")
    if not arena.exists():  # a short run of the grid method
        assert main(["run", config, "-o", str(arena), "--set", "create_simulation.reports=60"]) == 0
    page = visit([square, arena], scheme)
    charts = page.locator("[data-chart=map]").all()
    names = [set(chart.evaluate("(each) => each.data.map((trace) => trace.name)")) for chart in charts]
    assert all({"odometry", "trajectory", "truth"} <= each for each in names)
    assert ["closure, accepted (47)" in each for each in names] == [True, False]
    assert ["occupancy" in each for each in names] == [False, True]
    page.evaluate("document.querySelectorAll('details').forEach((each) => each.open = true)")
    found = axe.Axe().run(page).response["violations"]
    serious = [each for each in found if each["impact"] in ("serious", "critical")]
    assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []
    page.locator("button.closure").first.click()
    text = page.locator("body").inner_text()
    shown = [square.name, f"</script>{HOSTILE}", HOSTILE, "<b>jax</b>", "<i>note<i>", "<u>odds<u>"]
    assert [one for one in shown if one not in text] == []
    assert page.locator("main img, main i, main s, main u, main script").count() == 0


SHOWN = """() => {
    const all = (selector) => [...document.querySelectorAll(selector)];
    const pixels = (view) => view.getContext('2d').getImageData(0, 0, view.width, view.height).data;
    return {
        chosen: document.querySelector('.chosen').textContent,
        pressed: all('.closure[aria-pressed=true]').map((each) => Number(each.dataset.closure)),
        views: all('.view canvas').map((view) => [...pixels(view)].filter((_, k) => k % 4 == 0)),
    };
}"""
"""What the page shows of the chosen closure."""


def test_each_closure_is_reached_and_shows_its_views(square: Path, visit: Any) -> None:
    page, numbers = visit([square]), []
    table, views = read_closure_table(square), read_closure_views(square)
    assert views is not None
    gain = (view_records(views) or {})["gain"]
    while True:
        for button in page.locator("button.closure").all():
            button.click()
            number = int(button.get_attribute("data-closure"))
            earlier, later = table.steps[number].tolist()
            words = {"accepted": "accepted", "open": "not accepted"}[table.verdicts[number]]
            rows = np.searchsorted(views.step, [earlier, later])
            bright = np.minimum(np.ceil(views.view[rows] * gain), 255).reshape(2, -1).tolist()
            said = f"Steps {earlier} and {later}: {words}."
            assert page.evaluate(SHOWN) == {"chosen": said, "pressed": [number], "views": bright}
            numbers.append(number)
        if page.locator("button.forward").is_disabled():
            break
        page.locator("button.forward").click()
    assert sorted(set(numbers)) == list(range(CLOSURES))
