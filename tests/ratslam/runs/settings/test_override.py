"""Assignments such as those of `--set`: values that they set, and refused ones."""

from __future__ import annotations

import pytest

from ratslam.runs.settings.strict_yaml import override, parse, validate
from tactile.base.errors import InputError
from tests.ratslam.runs.settings.example_schema import VALID, Config, PoseCells, Simulation, overridden


def test_override() -> None:
    document = parse(VALID, "config.yaml")
    set_first = ["pose_cells.excite_sigma=2e-3", "pose_cells.shape.0=23", "others.0.simulation=4"]
    set_then = ["optional.excite_sigma=3", "gains={up: 1}", "gains.down=2", "name=a=b", "steps=1", "steps=2"]
    config = validate(override(document, set_first + set_then), Config)
    assert config.pose_cells == PoseCells(excite_sigma=2e-3, shape=(23, 21, 36))
    assert config.others[0] == Simulation(simulation=4)
    assert config.optional == PoseCells(excite_sigma=3)
    assert config.gains == {"up": 1, "down": 2}
    assert config.name == "a=b"
    assert config.steps == 2
    assert document == parse(VALID, "config.yaml")


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("steps", "steps: not an assignment; expected key=value such as pose_cells.cell_size=5e-2"),
        ("=1", ": not an assignment"),
        ("a..b=1", "a..b: not an assignment"),
        ("steps=", "steps: empty; expected a value"),
        ("steps=yes", "steps: 'yes'; expected a whole number"),
        ("steps=[1", "steps: a bracket that is not closed"),
        ("steps=010", "steps: 010; expected a number without leading zeros"),
        ("steps.x=1", "steps.x: steps is 5; expected a section to put a key in"),
        ("weights.2=1", "weights.2: weights has 2 items; expected an index below 2"),
        ("weights.x=1", "weights.x: weights has 2 items; expected an index below 2"),
        ("stepz=1", "stepz: unknown key; did you mean 'steps'?"),
        ("pose_cells.exite_sigma=1", "pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?"),
        ("pose_cells={exite_sigma: 1}", "pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?"),
        ("optional.shape.x=1", "optional.shape: a section of keys and values; expected a list"),
        ("source.kind=bag", "source.path: missing; The file of the recording."),
    ],
)
def test_override_errors(assignment: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        overridden(assignment, text="steps: 5\nweights: [1, 2]")
    assert str(caught.value).startswith(f"--set {message}")
