"""The parts of the report: words, citations, files, closures and views, and what a page may run."""

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

from evaluation.artifacts.run_reader import ClosureTable, ClosureViews, read_closure_table
from evaluation.metrics.run_metrics import NOT_JUDGED, UNFINISHED, Layers
from evaluation.metrics.scorecard import score_run
from evaluation.report.charts import overlay_chart
from evaluation.report.page import content_policy, embedded_json
from evaluation.report.run_report import VIEW_BYTES, closure_records, halve, view_records
from evaluation.report.verdict import describe_score, judge_map
from tactile.base.se2 import compose


def test_the_verdict_follows_the_doubt_and_an_unjudged_map_says_why() -> None:
    for doubt, level, share in (
        (0.0, "believed", "100%"),
        (0.001, "believed", "over 99%"),
        (0.29, "believed", "71%"),
        (0.31, "uncertain", "69%"),
        (0.5, "uncertain", "50%"),
        (0.7, "uncertain", "70%"),
        (0.71, "doubted", "71%"),
        (np.nan, "unjudged", ""),
    ):
        verdict = judge_map(doubt)
        assert (verdict.level, share in verdict.reason) == (level, True)
    said = [judge_map(np.nan, why).reason for why in (NOT_JUDGED, UNFINISHED, "no loop closure was accepted")]
    assert len(set(said)) == 3
    assert "no loop closure was accepted".casefold() in said[2].casefold()


def test_the_error_is_compared_in_words_and_runs_are_drawn_in_the_frame_of_their_truth(circle) -> None:
    def words(**changes) -> str:
        return describe_score(score_run(circle._replace(**changes)))

    better = words(final=circle.final + np.array([[0.001, 0, 0], [-0.001, 0, 0]] * 54))
    assert re.search(r"0\.001 m; that of odometry is \S+ m, \S+ times as much", better)
    assert "worse than odometry" in words(final=circle.odometry * 2, odometry=circle.final * 1.001)
    assert "the same" in words(final=circle.odometry)
    assert "unknown" in words(truth=None)
    turned = circle._replace(final=compose(np.array([3.0, -2.0, 1.0]), circle.final))
    runs = [SimpleNamespace(name="a", layers=Layers.align(run)) for run in (circle, turned)]
    for trace in overlay_chart(runs).data:
        assert np.stack([trace.x, trace.y], axis=1) == pytest.approx(circle.truth[:, :2], abs=1e-5)


@given(arrays(np.uint8, array_shapes(min_dims=3, max_dims=3, max_side=7)))
def test_half_the_resolution_keeps_the_brightness(image: np.ndarray) -> None:
    small = halve(image)
    count, rows, columns = image.shape
    shape = (rows, (columns + 1) // 2) if columns >= rows else ((rows + 1) // 2, columns)
    assert small.shape == (count, *shape)
    assert image.min() <= small.min() <= small.max() <= image.max()


def test_dim_views_are_brightened_and_many_reduced_to_fit_the_page() -> None:
    full = np.arange(256, dtype=np.uint8).repeat(4).reshape(2, 8, 64)
    dim = full // 3
    for view, gain in ((full, 255 / 253), (dim, 255 / 84), (np.zeros_like(full), 1.0)):
        record = view_records(ClosureViews(np.array([3, 7]), view))
        assert record["gain"] == pytest.approx(gain, rel=0.01)
        shown = np.frombuffer(b64decode(record["pixels"]), np.uint8).reshape(view.shape)
        assert (shown == 0).tolist() == (view == 0).tolist()
        assert shown.max() == (255 if view.any() else 0)
        assert (record["rows"], record["columns"], record["steps"]) == (8, 64, [3, 7])
    record = view_records(ClosureViews(np.arange(10_000), np.zeros((10_000, 20, 60), np.uint8)))
    assert VIEW_BYTES / 2 < len(b64decode(record["pixels"])) == 10_000 * 10 * 15 < VIEW_BYTES
    assert view_records(None) is None


def test_closures_come_with_their_evidence(tmp_path: Path, circle) -> None:
    rows = "36,0,accepted,9,0.123456789,inf\n20,3,open,5,1,nan\n"
    (tmp_path / "closures.csv").write_text(f"step,match_step,verdict,keyframe,posterior,odd\n{rows}")
    table = read_closure_table(tmp_path)
    assert table.steps.tolist() == [[0, 36], [3, 20]]
    record = closure_records(table, circle)
    assert record["verdicts"] == ["accepted", "not accepted"]
    evidence = {each["name"]: each["values"] for each in record["evidence"]}
    assert evidence == {"posterior": [0.12346, 1.0], "odd": ["inf", None]}
    assert record["apart"][0] == pytest.approx(np.hypot(*(circle.truth[0] - circle.truth[36])[:2]), rel=1e-4)
    assert record["times"][1] == [1.5, 10.0]
    earlier = closure_records(ClosureTable(np.array([[-5, 7]]), ["accepted"], {}), circle)
    assert (earlier["times"], earlier["apart"]) == ([[None, 3.5]], [None])


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
    scripts = f"default-src 'none'; script-src 'sha256-{digest}'; "
    assert policy == scripts + "style-src 'unsafe-inline'; img-src data: blob:"
