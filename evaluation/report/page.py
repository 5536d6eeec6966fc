"""The page: one file of HTML that works without network, with everything it shows inside it."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from evaluation.artifacts.run_reader import RUNNING
from evaluation.report.charts import GRID_SCALES, PALETTE, error_chart, overlay_chart, run_charts
from evaluation.report.run_report import RunReport, closure_records, view_records
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


PageRun = tuple[RunReport, Sequence[tuple[str, str, str]] | None]
"""A run and the settings in which it differs from the defaults: path, value and default of each; None: they
are unknown."""
LISTED = 6
"""Number of pieces of a map whose steps are listed."""
_ENDS = {"complete": "finished", RUNNING: "not finished"}


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
    """Writes the page of one run, or of several runs and their comparison, atomically; equal runs give equal
    pages.

    Args:
        citation: the content of a CITATION.cff.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    # The library takes most of the time of opening; the page works on its table before that.
    scripts = [(_TEMPLATES / "page.js").read_text(encoding="utf-8"), get_plotlyjs()]
    reports = [report for report, _ in runs]
    charts = [run_charts(report) for report in reports]
    shown = {"overlay": overlay_chart(reports), "errors": error_chart(reports)} if len(runs) > 1 else {}
    # Figures as plain data; their arrays of numbers are encoded as bytes.
    compared = {name: json.loads(chart.to_json()) for name, chart in shown.items() if chart is not None}
    data = {
        "palette": PALETTE,
        "gridScales": GRID_SCALES,
        "runs": [
            {
                "charts": {name: json.loads(chart.to_json()) for name, chart in drawn.items()},
                "closures": closure_records(report.closures, report.run),
                "views": view_records(report.views),
            }
            for report, drawn in zip(reports, charts, strict=True)
        ],
        "comparison": compared,
    }
    page = environment.get_template("page.html").render(
        title=", ".join(report.name for report in reports),
        policy=content_policy(scripts),
        style=(_TEMPLATES / "page.css").read_text(encoding="utf-8"),
        scripts=scripts,
        data=embedded_json(data),
        runs=[_run_context(k, run, drawn) for k, (run, drawn) in enumerate(zip(runs, charts, strict=True))],
        comparison=[_comparison_row(report) for report in reports] if len(runs) > 1 else None,
        columns=_COLUMNS,
        compared_charts=list(compared),
        citations=_read_citations(citation),
        citation=citation,
    )
    write_atomically(path, lambda temporary: temporary.write_bytes(page.encode()))


def content_policy(scripts: Sequence[str]) -> str:
    """The policy of a page that loads nothing and runs these scripts only."""
    digests = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"


def embedded_json(data: Any) -> str:
    """JSON in which no text can end the element around it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _run_context(number: int, run: PageRun, charts: dict[str, Any]) -> dict[str, Any]:
    """What the template `run.html` shows of a run."""
    report, settings = run
    return {
        "number": number,
        "report": report,
        "unfinished": report.manifest.status == RUNNING,
        "score": describe_score(report.card),
        "figures": _key_figures(report),
        "charts": [(name, *_CAPTIONS[name]) for name in charts if name != "map"],
        "settings": settings,
    }


def _read_citations(text: str) -> list[str]:
    """The program and its references, a line each: authors, year, title, place, identifier.

    Args:
        text: the content of a CITATION.cff.
    """
    content, lines = yaml.safe_load(text), []
    for entry in (content, *content.get("references", [])):
        authors = [
            author.get("name") or f"{author.get('family-names', '')}, {author.get('given-names', '')[:1]}."
            for author in entry.get("authors", [])
        ]
        some = [*authors[:-1], f"and {authors[-1]}"] if len(authors) > 1 else authors
        written = (", " if len(authors) > 2 else " ").join(some)
        year = f" ({entry['year']})" if "year" in entry else ""
        version = f" Version {entry['version']}." if "version" in entry else ""
        place = entry.get("collection-title") or entry.get("journal") or ""
        place = f" {place}." if place else ""
        identifier = f" doi:{entry['doi']}" if "doi" in entry else ""
        lines.append(f"{written}{year}. {entry['title']}.{version}{place}{identifier}".strip())
    return lines


def _key_figures(report: RunReport) -> list[tuple[str, str, str]]:
    """The figures in the head of a run, the most important first: name, value with its unit, remark."""
    error, run, count = report.card.position_error, report.run, len(report.closures.verdicts)
    if error.value is None:
        figures = [("Position error", "unknown", "no truth to compare with")]
    else:
        note = "" if error.odometry is None else f"odometry {error.odometry:.3g} {error.unit}"
        figures = [("Position error", f"{error.value:.3g} {error.unit}", note)]
    if run.has_pieces:
        sizes = np.sort(np.unique(run.piece, return_counts=True)[1])[::-1]
        listed = ", ".join(f"{size:,}" for size in sizes[:LISTED].tolist())
        more, share = " ..." if len(sizes) > LISTED else "", 1 - sizes[0] / sizes.sum()
        remark = f"{share:.0%} of the steps unjoined; {listed}{more} steps"
        figures.append(("Pieces", f"{len(sizes)}", remark))
    grid = report.grid_score.quantities if report.grid_score is not None else {}
    if grid and grid["map_brier"].value is not None:
        skill = grid["map_brier_skill"].value
        remark = "" if skill is None else f"skill {skill:.3g}"
        figures.append(("Grid, Brier score", f"{grid['map_brier'].value:.3g}", remark))
    if warned := len(run.warnings):
        figures.append(("Input", "warned", f"{warned} warning{'s' * (warned > 1)}"))
    if len(run.nodes):
        figures.append(("Experiences", f"{len(run.nodes):,}", f"{len(run.links):,} links"))
    if count:
        accepted = int(report.closures.accepted().sum())
        figures.append(("Closures accepted", f"{accepted:,}", f"of {count:,} considered"))
    seconds = float(run.time[-1] - run.time[0])
    duration = f"{seconds:.3g} s" if seconds < 120 else f"{seconds / 60:.3g} min"
    figures.append(("Duration", duration, f"{len(run.time):,} steps"))
    if len(report.cost):
        figures.append(("Cost of a step", f"{1e3 * float(np.median(report.cost[:, 1])):.3g} ms", "median"))
    return figures


_COLUMNS = (
    "run", "method", "status", "steps", "doubt", "final, m", "online, m",
    "odometry, m", "experiences", "closures", "refused", "ms a step",
)  # fmt: skip
"""Columns of the table of several runs."""


def _comparison_row(report: RunReport) -> list[str]:
    """The row of a run in the table of several; "–" where it has no figure."""
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
        _number(1e3 * float(np.median(report.cost[:, 1])) if len(report.cost) else None),
    ]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
