"""The slow reference: the engine again, in plain NumPy and Python, written from the text alone.

Two engines live here. The *stock* one follows `openratslam.md` sections 1 to 5 with every quirk of section 7,
and must reproduce the reference traces. The *plain* one follows "Semantics of the classic backend" in
`ratslam/README.md`, and must agree with the JAX engine.
"""
