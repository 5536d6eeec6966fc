"""`closures.csv`: every closure candidate with its evidence and verdict."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ratslam.keyframes.loop_closures import Verdict

COLUMNS = "keyframe,match,step,match_step,shift,mass,gain,sequence,distance,verdict,weight"


def write_closures(path: Path, table: np.ndarray, first_step: np.ndarray) -> None:
    """Writes the candidates of `ClosureLog.table`; first_step: [N] the step of each keyframe."""
    lines = [COLUMNS]
    for frame, match, shift, mass, gain, sequence, distance, verdict, weight in table.tolist():
        frame, match = int(frame), int(match)
        lines.append(
            f"{frame},{match},{first_step[frame]},{first_step[match]},{int(shift)},{mass!r},{gain!r},"
            f"{int(sequence)},{distance!r},{Verdict(int(verdict)).name.lower()},{weight!r}"
        )
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
