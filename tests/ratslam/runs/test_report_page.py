"""The report in a real browser: opened from a file, used by mouse and keyboard, checked by axe."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.recorded_views import read_closure_views
from evaluation.report.charts import PALETTE
from evaluation.report.run_report import view_records
from ratslam.cli import main
from ratslam.runs.map_results import write_report
from tests.helpers.square_run import copy_square_run

axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="of the extra [dev]")
playwright = pytest.importorskip("playwright.sync_api", reason="of the extra [dev]")

ROOT = Path(__file__).parents[3]
CHROMIUM = shutil.which("chromium")
HOSTILE = "<script>alert(1)</script>"
DRAWN = "[...document.querySelectorAll('.chart')].every((each) => each.querySelector('.main-svg .legend'))"
CLOSURES = 70
"""Closures kept in the run under test: more than a page of its table."""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH")


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with closures and truth, all but some of its closures removed."""
    path = copy_square_run(tmp_path_factory.mktemp("square") / "square")
    lines = (path / "closures.csv").read_text().splitlines(keepends=True)
    verdicts = [line.replace("accepted", "open") if k % 3 == 0 else line for k, line in enumerate(lines)]
    (path / "closures.csv").write_text("".join(verdicts[: CLOSURES + 1]))
    return path


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the grid method."""
    path = tmp_path_factory.mktemp("arena") / "arena"
    config = str(ROOT / "configs" / "create_arena.yaml")
    assert main(["run", config, "-o", str(path), "--set", "create_simulation.reports=60"]) == 0
    return path


@pytest.fixture(scope="module")
def variant(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A copy of the run under another name and without some files."""

    def copy(name: str, *removed: str) -> Path:
        path = tmp_path_factory.mktemp("variant") / name
        shutil.copytree(square, path)
        for file in removed:
            (path / file).unlink()
        return path

    return copy


@pytest.fixture(scope="module")
def runs(square: Path, arena: Path, variant: Callable[..., Path]) -> dict[str, list[Path]]:
    """Runs of each kind."""
    blind = variant("blind", "scorecard.json", "online_error.csv")
    (blind / "truth.tum").write_text("")
    killed = variant(
        "killed", "scorecard.json", "health.json", "trajectory.tum", "map.tum", "map.json", "map.g2o",
        "map.npz", "closures.csv", "closure_views.npz", "calibration.yaml",
    )  # fmt: skip
    manifest = json.loads((killed / "manifest.json").read_text())
    (killed / "manifest.json").write_text(json.dumps(manifest | {"status": "running"}))
    doubted = variant("doubted", "scorecard.json")
    (doubted / "health.json").write_text('{"worse_than_odometry": 0.93}')
    shutil.copy(doubted / "odometry.tum", doubted / "trajectory.tum")
    return {
        "square": [square], "grid": [arena], "blind": [blind], "killed": [killed], "doubted": [doubted],
        "several": [square, arena, blind],
    }  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield program
        program.close()


class Visit:
    """A page that was opened from a file, without network.

    Attributes:
        page: the browser's page. faults: its console messages, errors and dialogs. requests: all it asked for
            besides itself.
    """

    def __init__(self, browser: Any, path: Path, scheme: str = "light") -> None:
        context = browser.new_context(color_scheme=scheme, viewport={"width": 1280, "height": 1000})
        self.faults: list[str] = []
        self.requests: list[str] = []
        context.route("**", self._watch)
        self.page = context.new_page()
        self.page.on("console", lambda message: self.faults.append(message.text))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("dialog", self._dismiss)
        self.page.goto(path.as_uri())
        self.page.evaluate("dispatchEvent(new Event('beforeprint'))")  # draws the charts out of view too
        self.page.wait_for_function(DRAWN)

    def _watch(self, route: Any) -> None:
        url = route.request.url
        if route.request.is_navigation_request() and url.startswith("file:"):
            route.continue_()
        else:
            self.requests.append(url)
            route.abort()

    def _dismiss(self, dialog: Any) -> None:
        self.faults.append(f"dialog: {dialog.message}")
        dialog.dismiss()


@pytest.fixture
def visit(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Visit]]:
    """Writes the report of some runs and opens it."""
    visits: list[Visit] = []

    def open_page(directories: list[Path], scheme: str = "light") -> Visit:
        write_report(directories, tmp_path / "report.html")
        visits.append(Visit(browser, tmp_path / "report.html", scheme))
        return visits[-1]

    yield open_page
    for each in visits:
        assert each.faults == []
        assert [url for url in each.requests if not url.startswith(("data:", "blob:"))] == []
        each.page.context.close()


@pytest.mark.parametrize(
    ("kind", "verdict", "charts"),
    [
        (
            "square",
            "Believe this map. It is .* likely no worse .* Against the truth",
            "map error doubt belief cost",
        ),
        ("grid", "The map is not judged.* Against the truth", "map error cost"),
        ("blind", "Believe this map.* The truth is unknown, so there is no score", "map doubt belief cost"),
        ("killed", "(Believe|Take|Do not believe) .* Against the truth", "map error doubt belief cost"),
        ("doubted", "Do not believe this map. It is 93% likely worse", "map error doubt belief cost"),
    ],
)
def test_a_page_shows_its_run(kind: str, verdict: str, charts: str, runs: Any, visit: Any) -> None:
    page = visit(runs[kind]).page
    assert re.search(verdict, " ".join(page.locator(".verdict").inner_text().split()))
    shown = page.eval_on_selector_all(".chart", "(all) => all.map((each) => each.dataset.chart).join(' ')")
    assert shown == charts
    names = page.evaluate("document.querySelector('[data-chart=map]').data.map((trace) => trace.name)")
    assert {"odometry", "trajectory"} <= set(names)
    assert ("truth" in names) == (kind != "blind")
    assert ("occupancy" in names) == (kind == "grid")
    assert ("map, not believed" in names) == (kind == "doubted")
    assert ("closure, accepted (47)" in names) == (kind in ("square", "blind", "doubted"))
    assert ("not finished: killed, or still running" in page.locator(".lead").inner_text()) == (
        kind == "killed"
    )
    assert "match_sd" in page.locator("main").inner_text() or kind == "grid"


def test_several_runs_are_compared(runs: Any, visit: Any) -> None:
    page = visit(runs["several"]).page
    rows = page.locator("#comparison tbody tr")
    assert [rows.nth(k).locator("th").inner_text() for k in range(3)] == ["square", "arena", "blind"]
    names = page.evaluate("document.querySelector('[data-chart=overlay]').data.map((trace) => trace.name)")
    assert names == ["truth", "square", "arena", "blind"]
    names = page.evaluate("document.querySelector('[data-chart=errors]').data.map((trace) => trace.name)")
    assert names == ["square", "arena"]
    assert page.locator("article.run").count() == 3


SHOWN = """() => {
    const all = (selector) => [...document.querySelectorAll(selector)];
    const pixels = (view) => view.getContext('2d').getImageData(0, 0, view.width, view.height).data;
    const shapes = document.querySelector('[data-chart=map]').layout.shapes;
    return {
        chosen: document.querySelector('.chosen').textContent,
        pressed: all('.closure[aria-pressed=true]').map((each) => Number(each.dataset.closure)),
        views: all('.view canvas').map((view) => [...pixels(view)].filter((_, k) => k % 4 == 0)),
        labels: all('.view canvas').map((view) => view.getAttribute('aria-label')),
        marks: shapes.filter((each) => each.type === 'circle').length,
    };
}"""
"""What the page shows of the chosen closure."""


def check_shown(shown: dict[str, Any], number: int, directory: Path) -> None:
    """Checks that the page shows closure `number` of a run with both its views."""
    table, views = read_closure_table(directory), read_closure_views(directory)
    assert views is not None
    earlier, later = table.steps[number].tolist()
    words = {"accepted": "accepted", "open": "not accepted"}[table.verdicts[number]]
    assert shown["chosen"] == f"Steps {earlier} and {later}: {words}."
    assert shown["pressed"] == [number]
    rows = np.searchsorted(views.step, [earlier, later])
    gain = (view_records(views) or {})["gain"]
    bright = np.minimum(np.ceil(views.view[rows] * gain), 255)
    assert shown["views"] == bright.reshape(2, -1).tolist()
    assert [label.split(",")[0] for label in shown["labels"]] == [
        f"View at step {k}" for k in (earlier, later)
    ]
    assert shown["marks"] == 4


def test_each_closure_is_reached_by_mouse_and_shows_its_views(runs: Any, visit: Any) -> None:
    (directory,), page = runs["square"], visit(runs["square"]).page
    numbers = []
    while True:
        for button in page.locator("button.closure").all():
            button.click()
            numbers.append(int(button.get_attribute("data-closure")))
            check_shown(page.evaluate(SHOWN), numbers[-1], directory)
        if page.locator("button.forward").is_disabled():
            break
        page.locator("button.forward").click()
    assert sorted(set(numbers)) == list(range(CLOSURES))


def test_each_closure_is_reached_by_keyboard(runs: Any, visit: Any) -> None:
    (directory,), page = runs["square"], visit(runs["square"]).page
    focused = "document.activeElement.dataset.closure ?? document.activeElement.className"
    numbers: list[int] = []
    for _ in range(40):  # from the top of the page to the table
        page.keyboard.press("Tab")
        if page.evaluate(focused).isdecimal():
            break
    while len(numbers) < CLOSURES:
        name = page.evaluate(focused)
        if not name.isdecimal():  # past the last row of this page of the table
            page.locator("button.forward").focus()
            page.keyboard.press("Enter")
            page.keyboard.press("Tab")
            page.keyboard.press("Tab")  # over the table, which scrolls
            if not page.evaluate(focused).isdecimal():
                page.keyboard.press("Tab")
            continue
        page.keyboard.press("Enter")
        numbers.append(int(name))
        check_shown(page.evaluate(SHOWN), numbers[-1], directory)
        assert page.evaluate(focused) == name
        page.keyboard.press("Tab")
    assert numbers == list(range(CLOSURES))


def test_a_closure_is_chosen_on_the_map(runs: Any, visit: Any) -> None:
    (directory,), page = runs["square"], visit(runs["square"]).page
    page.locator("[data-chart=map]").scroll_into_view_if_needed()
    found = set()
    for mark in page.locator("[data-chart=map] .points path").all()[-20:]:
        box = mark.bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        shown = page.evaluate(SHOWN)
        check_shown(shown, shown["pressed"][0], directory)
        found.add(shown["pressed"][0])
    assert len(found) > 5  # marks lie over one another, and a slow machine takes the last one again


def test_closures_are_filtered_and_walked_through(runs: Any, visit: Any) -> None:
    page = visit(runs["square"]).page
    page.locator(".filter").select_option(label="not accepted, 23")
    assert page.locator(".range").inner_text() == "1–23 of 23"
    page.locator("button.closure").first.click()
    page.locator("button.next").click()
    assert page.evaluate(SHOWN)["chosen"].endswith("not accepted.")
    assert page.locator("tr.chosen").count() == 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_fault(scheme: str, runs: Any, visit: Any) -> None:
    page = visit(runs["several"], scheme).page
    page.evaluate("document.querySelectorAll('details').forEach((each) => each.open = true)")
    found = axe.Axe().run(page).response["violations"]
    serious = [each for each in found if each["impact"] in ("serious", "critical")]
    assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []


def test_the_theme_can_be_changed(runs: Any, visit: Any) -> None:
    page = visit(runs["grid"], "dark").page
    ground = "document.querySelector('.chart').layout.paper_bgcolor"
    assert page.evaluate(ground) == PALETTE["dark"]["ground"]
    page.locator("#theme").click()
    assert page.locator("#theme").inner_text() == "Dark theme"
    page.wait_for_function(f"{ground} === {PALETTE['light']['ground']!r}")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(246, 247, 248)"


def test_hostile_names_are_shown_as_text(variant: Any, runs: Any, visit: Any) -> None:
    """In the names of the run, its source, its configuration, its files, and the columns of its evidence."""
    name = "<img src=x onerror=alert(2)>"
    run = variant(name)
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["recording"]["name"] = f"</script>{HOSTILE}"
    manifest["versions"]["<b>jax</b>"] = HOSTILE
    (run / "manifest.json").write_text(json.dumps(manifest))
    config = re.sub(
        r"file: .*", f"file: '/{HOSTILE.replace('/', '')}'", (run / "config.yaml").read_text(), count=1
    )
    (run / "config.yaml").write_text(config)
    (run / "<i>note<i>").write_text("")
    table = (
        (run / "closures.csv").read_text().replace("log_odds", "<u>odds<u>").replace(",open,", ",<s>bad</s>,")
    )
    (run / "closures.csv").write_text(table)
    page = visit([run, *runs["killed"]]).page
    page.evaluate("document.querySelectorAll('details').forEach((each) => each.open = true)")
    page.locator("button.closure").first.click()
    text = page.locator("body").inner_text()
    for shown in (
        name,
        f"</script>{HOSTILE}",
        HOSTILE,
        "<b>jax</b>",
        HOSTILE.replace("/", ""),
        "<i>note<i>",
        "<u>odds<u>",
    ):
        assert shown in text
    assert "closure, <s>bad</s> (23)" in page.locator("[data-chart=map] .legend").first.text_content()
    assert name in page.locator("[data-chart=overlay] .legend").text_content()
    assert page.locator("main img, main i, main s, main u, main script").count() == 0
