"""The slow reference: RatSLAM in plain NumPy and Python, float64, written from the texts alone.

`classic` is OpenRatSLAM with every quirk, checked against recorded outputs of the compiled reference;
`clean` is the quirk-free semantics of `ratslam/README.md`, which the engine itself is checked against.
What both share lies beside them: the attractor (`cells`), the table of view differences (`views`), angles and
rings (`circle`), parameters and streams.

    python -m tests.oracle FILE.npz ... [--quirks on|off]
"""
