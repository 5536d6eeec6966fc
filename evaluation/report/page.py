"""The page: one file of HTML that works without network, with everything it shows inside it."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from evaluation.artifacts.manifest import RUNNING
from evaluation.metrics.scorecard import position_error, scorecard_lines
from evaluation.report.charts import GRID_SCALES, PALETTE, error_chart, overlay_chart, run_charts
from evaluation.report.run_report import RunReport, closure_records, describe_status, view_records
from evaluation.report.verdict import describe_score
from tactile.base.errors import InputError
from tactile.base.files import write_atomically

_TEMPLATES = Path(__file__).parent / "templates"
_CAPTIONS = {
    "error": ("Error over time", "Distance from the truth after one alignment of the whole path."),
    "doubt": (
        "Doubt over time",
        "Probability, by the map itself, that it is worse than odometry. It needs no truth.",
    ),
    "belief": (
        "Belief of the pose cells",
        "Probability of the heaviest packet of activity, of the one that competes with it, and of a new "
        "place, at every keyframe.",
    ),
    "spread": ("Uncertainty over time", "Standard deviation of the position, by the method itself."),
    "cost": (
        "Cost of a step",
        "Computing time on the machine of the run. The first chunks include the compilation of the program.",
    ),
}
"""Heading and caption of each chart besides the map."""


class PageRun(NamedTuple):
    """A run and the settings in which it differs from the defaults: path, value and default of each; None:
    they are unknown."""

    report: RunReport
    settings: Sequence[tuple[str, str, str]] | None


def check_report_libraries(where: str) -> None:
    """Checks that the libraries of the page are installed.

    Args:
        where: what asks for the page, for the error.

    Raises:
        InputError: one is not.
    """
    missing = [name for name in ("jinja2", "plotly") if find_spec(name) is None]
    if missing:
        found = f"{' and '.join(missing)} not installed"
        raise InputError(where, found, "the extra 'report'", "pip install 'ratslam[report]'")


def write_page(path: Path, runs: Sequence[PageRun], citation: str) -> None:
    """Writes the page of one run, or of several runs and their comparison, atomically.

    Args:
        citation: the content of a CITATION.cff.

    Raises:
        InputError: the libraries of the page are not installed.
    """
    check_report_libraries("report")
    page = render_page(runs, citation).encode()
    write_atomically(path, lambda temporary: temporary.write_bytes(page))


def render_page(runs: Sequence[PageRun], citation: str) -> str:
    """The page as a text; equal runs give equal texts. Its arguments are those of `write_page`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    # The library takes most of the time of opening; the page works on its table before that.
    scripts = [(_TEMPLATES / "page.js").read_text(encoding="utf-8"), get_plotlyjs()]
    reports = [run.report for run in runs]
    charts = [run_charts(report) for report in reports]
    shown = {"overlay": overlay_chart(reports), "errors": error_chart(reports)} if len(runs) > 1 else {}
    compared = {name: _figure_data(chart) for name, chart in shown.items() if chart is not None}
    data = {
        "palette": PALETTE,
        "gridScales": GRID_SCALES,
        "runs": [_run_data(*pair) for pair in zip(reports, charts, strict=True)],
        "comparison": compared,
    }
    return environment.get_template("page.html").render(
        title=", ".join(report.name for report in reports),
        policy=content_policy(scripts),
        style=(_TEMPLATES / "page.css").read_text(encoding="utf-8"),
        scripts=scripts,
        data=embedded_json(data),
        runs=[_run_context(k, *pair) for k, pair in enumerate(zip(runs, charts, strict=True))],
        comparison=compare_figures(reports) if len(runs) > 1 else None,
        compared_charts=list(compared),
        citations=read_citations(citation),
        citation=citation,
    )


def content_policy(scripts: Sequence[str]) -> str:
    """The policy of a page that loads nothing and runs these scripts only."""
    digests = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"


def embedded_json(data: Any) -> str:
    """JSON in which no text can end the element around it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _run_data(report: RunReport, charts: dict[str, Any]) -> dict[str, Any]:
    return {
        "charts": {name: _figure_data(chart) for name, chart in charts.items()},
        "closures": closure_records(report.closures, report.run),
        "views": view_records(report.views),
    }


def _figure_data(figure: Any) -> Any:
    """A figure as plain data; arrays of numbers are encoded as bytes."""
    return json.loads(figure.to_json())


def _run_context(number: int, run: PageRun, charts: dict[str, Any]) -> dict[str, Any]:
    report = run.report
    return {
        "number": number,
        "name": report.name,
        "status": describe_status(report),
        "unfinished": report.manifest.status == RUNNING,
        "backend": report.backend,
        "source": report.source,
        "manifest": report.manifest,
        "verdict": report.verdict,
        "warnings": report.run.warnings,
        "score": describe_score(report.card),
        "figures": key_figures(report),
        "sections": scorecard_lines(report.card),
        "closures": len(report.closures.verdicts),
        "views": report.views is not None,
        "charts": [(name, *_CAPTIONS[name]) for name in charts if name != "map"],
        "settings": run.settings,
        "files": report.files,
    }


def read_citations(text: str) -> list[str]:
    """The program and its references, a line each: authors, year, title, place, identifier.

    Args:
        text: the content of a CITATION.cff.
    """
    content = yaml.safe_load(text)
    return [_line(entry) for entry in (content, *content.get("references", []))]


def _line(entry: dict[str, Any]) -> str:
    authors = [_name(author) for author in entry.get("authors", [])]
    some = [*authors[:-1], f"and {authors[-1]}"] if len(authors) > 1 else authors
    written = (", " if len(authors) > 2 else " ").join(some)
    year = f" ({entry['year']})" if "year" in entry else ""
    version = f" Version {entry['version']}." if "version" in entry else ""
    place = entry.get("collection-title") or entry.get("journal") or ""
    identifier = f" doi:{entry['doi']}" if "doi" in entry else ""
    return f"{written}{year}. {entry['title']}.{version}{f' {place}.' if place else ''}{identifier}".strip()


def _name(author: dict[str, str]) -> str:
    return author.get("name") or f"{author.get('family-names', '')}, {author.get('given-names', '')[:1]}."


LISTED = 6
"""Number of pieces of a map whose steps are listed."""
_ENDS = {"complete": "finished", RUNNING: "not finished"}


class KeyFigure(NamedTuple):
    """A figure in the head of the page: what it is, its value with the unit, and a remark."""

    label: str
    value: str
    note: str = ""


class Comparison(NamedTuple):
    """A table: the headings of its columns, and a row of cells for each run, its name first."""

    columns: list[str]
    rows: list[list[str]]


def key_figures(report: RunReport) -> list[KeyFigure]:
    """The figures of one run, the most important first."""
    figures = [_error(report), *_pieces(report), *_grid(report)]
    if warned := len(report.run.warnings):
        figures.append(KeyFigure("Input", "warned", f"{warned} warning{'s' * (warned > 1)}"))
    if len(report.run.nodes):
        figures.append(
            KeyFigure("Experiences", f"{len(report.run.nodes):,}", f"{len(report.run.links):,} links")
        )
    if report.closures.verdicts:
        count, accepted = len(report.closures.verdicts), int(report.closures.accepted().sum())
        figures.append(KeyFigure("Closures accepted", f"{accepted:,}", f"of {count:,} considered"))
    time = report.run.time
    figures.append(KeyFigure("Duration", _duration(float(time[-1] - time[0])), f"{len(time):,} steps"))
    if len(report.cost.value):
        cost = 1e3 * float(np.median(report.cost.value))
        figures.append(KeyFigure("Cost of a step", f"{cost:.3g} ms", "median"))
    return figures


def compare_figures(reports: Sequence[RunReport]) -> Comparison:
    """The figures of several runs, a row each; "–" where a run has none."""
    columns = [
        "run", "method", "status", "steps", "doubt", "final, m", "online, m",
        "odometry, m", "experiences", "closures", "refused", "ms a step",
    ]  # fmt: skip
    return Comparison(columns, [_row(report) for report in reports])


def _row(report: RunReport) -> list[str]:
    final, online = (report.card.quantities[name] for name in ("ate_final", "ate_online"))
    closures, accepted = len(report.closures.verdicts), int(report.closures.accepted().sum())
    doubt = report.run.doubt
    return [
        report.name,
        report.backend or "–",
        _ENDS.get(report.manifest.status, report.manifest.status),
        f"{len(report.run.time):,}",
        "–" if np.isnan(doubt) else f"{doubt:.0%}",
        *(_number(value) for value in (final.value, online.value, final.odometry)),
        f"{len(report.run.nodes):,}" if len(report.run.nodes) else "–",
        *((f"{accepted:,}", f"{closures - accepted:,}") if closures else ("–", "–")),
        _number(1e3 * float(np.median(report.cost.value)) if len(report.cost.value) else None),
    ]


def _error(report: RunReport) -> KeyFigure:
    error = position_error(report.card)
    if error.value is None:
        return KeyFigure("Position error", "unknown", "no truth to compare with")
    note = "" if error.odometry is None else f"odometry {error.odometry:.3g} {error.unit}"
    return KeyFigure("Position error", f"{error.value:.3g} {error.unit}", note)


def _pieces(report: RunReport) -> list[KeyFigure]:
    """Of a map in several pieces: how many, the share of steps outside the largest, and the steps of each."""
    if not report.run.has_pieces:
        return []
    sizes = np.sort(np.unique(report.run.piece, return_counts=True)[1])[::-1]
    share = 1 - sizes[0] / sizes.sum()
    listed = ", ".join(f"{size:,}" for size in sizes[:LISTED].tolist())
    more = " ..." if len(sizes) > LISTED else ""
    return [KeyFigure("Pieces", f"{len(sizes)}", f"{share:.0%} of the steps unjoined; {listed}{more} steps")]


def _grid(report: RunReport) -> list[KeyFigure]:
    if report.grid_score is None or report.grid_score.quantities["map_brier"].value is None:
        return []
    score = report.grid_score.quantities
    skill = score["map_brier_skill"].value
    return [
        KeyFigure(
            "Grid, Brier score",
            f"{score['map_brier'].value:.3g}",
            "" if skill is None else f"skill {skill:.3g}",
        )
    ]


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds < 120 else f"{seconds / 60:.3g} min"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
