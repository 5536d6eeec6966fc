"""The parts of the report: words, citations, files, closures and views, and what a page may run."""

from __future__ import annotations

import json
import re
from base64 import b64decode, b64encode
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from evaluation.artifacts.closure_table import ClosureTable, read_closure_table, write_closure_pairs
from evaluation.artifacts.manifest import read_manifest
from evaluation.artifacts.recorded_views import (
    NAME,
    ClosureViews,
    eight_bit,
    read_closure_views,
    write_closure_views,
)
from evaluation.metrics.run_arrays import UNFINISHED
from evaluation.metrics.scorecard import score_run
from evaluation.plots.map_plot import Layers
from evaluation.report.charts import PALETTE, overlay_chart
from evaluation.report.page import content_policy, embedded_json, read_citations
from evaluation.report.run_files import FILES, OTHER, list_run_files
from evaluation.report.run_report import VIEW_BYTES, closure_records, halve, view_records
from evaluation.report.verdict import describe_score, judge_map
from tactile.base.errors import InputError
from tactile.base.se2 import compose

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("doubt", "level", "words"),
    [
        (0.0, "believed", "100% likely no worse"),
        (0.001, "believed", "over 99% likely no worse"),
        (0.29, "believed", "71% likely no worse"),
        (0.5, "uncertain", "leaves 50%"),
        (0.71, "doubted", "71% likely worse"),
        (np.nan, "unjudged", "does not say"),
        ("no loop closure was accepted, the map is the odometry", "unjudged", "nothing corrects its drift"),
        (UNFINISHED, "unjudged", "when the run has ended"),
    ],
)
def test_the_verdict_follows_the_doubt(doubt: float | str, level: str, words: str) -> None:
    verdict = judge_map(np.nan, doubt) if isinstance(doubt, str) else judge_map(doubt)
    assert verdict.level == level
    assert words in verdict.reason


def test_the_score_is_told_in_words(circle) -> None:
    better = circle._replace(final=circle.final + np.array([[0.001, 0, 0], [-0.001, 0, 0]] * 54))
    assert re.search(r"error is 0\.001 m; that of odometry is \S+ m, \S+ times as much", words(better))
    worse = words(circle._replace(final=circle.odometry * 2, odometry=circle.final * 1.001))
    assert "times as far off, worse than odometry." in worse
    assert words(circle._replace(final=circle.odometry)).endswith(", the same.")
    assert words(circle._replace(truth=None)) == "The truth is unknown, so there is no score."


def words(run) -> str:
    return describe_score(score_run(run))


def test_compared_runs_are_drawn_in_the_frame_of_their_truth(circle) -> None:
    """Each map has a frame of its own."""
    turned = circle._replace(final=compose(np.array([3.0, -2.0, 1.0]), circle.final))
    runs = [
        SimpleNamespace(name=name, layers=Layers.align(run)) for name, run in (("a", circle), ("b", turned))
    ]
    traces = overlay_chart(runs).data
    assert [trace.name for trace in traces] == ["truth", "a", "b"]
    for trace in traces:
        assert np.stack([trace.x, trace.y], axis=1) == pytest.approx(circle.truth[:, :2], abs=1e-5)


def test_every_reference_is_cited() -> None:
    lines = read_citations((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert len(lines) == 3
    assert lines[0].startswith("The ratslam authors. ratslam")
    assert "Salman, M. and Pearson, M. (2016)" in lines[1]
    assert "doi:10.1109/ROBIO.2016.7866416" in lines[1]
    assert "Fox, C., Evans, M., Pearson, M., and Prescott, T. (2012)" in lines[2]


def test_files_are_explained(tmp_path: Path) -> None:
    for name in ("steps.csv", "config.yaml", "<b>.txt", ".hidden"):
        (tmp_path / name).write_text("ab")
    found = list_run_files(tmp_path)
    assert [(name, size) for name, size, _ in found] == [
        ("config.yaml", 2),
        ("steps.csv", 2),
        ("<b>.txt", 2),
    ]
    assert found[-1][2] == OTHER


def test_the_readme_and_the_page_explain_the_same_files() -> None:
    text = (ROOT / "ratslam" / "runs" / "README.md").read_text(encoding="utf-8")
    table = text[text.index("## The run directory") :].split("\n## ")[0]
    named = {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in row.split(", ")}
    assert {name.strip("`") for name in named} == set(FILES)


@given(arrays(np.uint8, array_shapes(min_dims=3, max_dims=3, max_side=7)))
def test_half_the_resolution_keeps_the_brightness(image: np.ndarray) -> None:
    small = halve(image)
    count, rows, columns = image.shape
    shape = (rows, (columns + 1) // 2) if columns >= rows else ((rows + 1) // 2, columns)
    assert small.shape == (count, *shape)
    assert image.min() <= small.min() <= small.max() <= image.max()


def test_dim_views_are_brightened_and_full_ones_are_not() -> None:
    full = np.arange(256, dtype=np.uint8).repeat(4).reshape(2, 8, 64)
    dim = full // 3
    for view, gain in ((full, 255 / 253), (dim, 255 / 84), (np.zeros_like(full), 1.0)):
        record = view_records(ClosureViews(np.array([3, 7]), view))
        assert record is not None
        assert record["gain"] == pytest.approx(gain, rel=0.01)
        shown = np.frombuffer(b64decode(record["pixels"]), np.uint8).reshape(view.shape)
        assert (shown == 0).tolist() == (view == 0).tolist()
        assert shown.max() == (255 if view.any() else 0)


def test_views_are_reduced_only_to_fit_the_page() -> None:
    rng = np.random.default_rng(0)
    small = ClosureViews(np.array([3, 7]), rng.integers(0, 256, (2, 3, 6), np.uint8))
    record = view_records(small)
    assert record is not None
    assert (record["rows"], record["columns"], record["steps"]) == (3, 6, [3, 7])
    assert len(b64decode(record["pixels"])) == small.view.size
    many = ClosureViews(np.arange(10_000), np.zeros((10_000, 20, 60), np.uint8))
    record = view_records(many)
    assert record is not None
    assert VIEW_BYTES / 2 < len(b64decode(record["pixels"])) == 10_000 * 10 * 15 < VIEW_BYTES
    assert view_records(None) is None


def test_views_read_back_equal(tmp_path: Path) -> None:
    image = eight_bit(np.array([[[0.0, 1.0], [1e-6, 0.0]], [[1.0, 0.0], [0.5, 0.0]]]))
    assert image.tolist() == [[0, 1], [255, 128]]
    views = ClosureViews(np.array([4]), image[None])
    write_closure_views(tmp_path / NAME, views)
    again = read_closure_views(tmp_path)
    assert again is not None
    assert [np.array_equal(*pair) for pair in zip(views, again, strict=True)] == [True, True]
    np.savez(tmp_path / NAME, step=np.arange(2), view=image[None])
    with pytest.raises(InputError, match=r"closure_views\.npz"):
        read_closure_views(tmp_path)
    assert read_closure_views(tmp_path / "elsewhere") is None


def test_closures_come_with_their_evidence(tmp_path: Path, circle) -> None:
    text = (
        "step,match_step,verdict,keyframe,posterior,odd\n36,0,accepted,9,0.123456789,inf\n20,3,open,5,1,nan\n"
    )
    (tmp_path / "closures.csv").write_text(text)
    table = read_closure_table(tmp_path)
    assert table.steps.tolist() == [[0, 36], [3, 20]]
    record = closure_records(table, circle)
    assert record["verdicts"] == ["accepted", "not accepted"]
    assert [(each["name"], each["values"]) for each in record["evidence"]] == [
        ("posterior", [0.12346, 1.0]),
        ("odd", ["inf", None]),
    ]
    assert record["apart"][0] == pytest.approx(np.hypot(*(circle.truth[0] - circle.truth[36])[:2]), rel=1e-4)
    assert record["times"][1] == [1.5, 10.0]


def test_closures_of_an_earlier_run_have_no_time(circle) -> None:
    record = closure_records(ClosureTable(np.array([[-5, 7]]), ["accepted"], {}), circle)
    assert record["times"] == [[None, 3.5]]
    assert record["apart"] == [None]


def test_closures_without_evidence_read_back_equal(tmp_path: Path) -> None:
    write_closure_pairs(tmp_path / "closures.csv", np.array([[9, 2], [12, 3]]))
    table = read_closure_table(tmp_path)
    assert (table.steps.tolist(), table.verdicts, table.evidence) == ([[2, 9], [3, 12]], ["accepted"] * 2, {})


def test_a_run_without_a_manifest_is_not_finished(tmp_path: Path) -> None:
    assert read_manifest(tmp_path).status == "running"
    (tmp_path / "manifest.json").write_text('{"recording": 3}')
    with pytest.raises(InputError, match="expected the manifest of a run"):
        read_manifest(tmp_path)


@given(
    st.recursive(st.text() | st.integers(), lambda part: st.lists(part) | st.dictionaries(st.text(), part))
)
def test_no_text_ends_the_data_of_a_page(value: object) -> None:
    text = embedded_json([value, "</script><!--"])
    assert not {"<", ">", "&"} & set(text)
    assert json.loads(text) == [value, "</script><!--"]


def test_the_policy_allows_these_scripts_and_no_others() -> None:
    policy = content_policy(["alert('π')"])
    digest = b64encode(sha256("alert('π')".encode()).digest()).decode()
    assert policy == (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data: blob:"
    )


def test_both_themes_colour_the_same_roles() -> None:
    assert PALETTE["light"].keys() == PALETTE["dark"].keys()
