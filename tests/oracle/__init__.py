"""Slow reference implementations of the classic backend in NumPy and Python, written from its specification.

The *stock* engine follows `openratslam.md`, sections 1 to 5, with all deviations of section 7, and must
reproduce the reference traces. The *plain* engine follows "Semantics of the classic backend" in
`ratslam/classic/README.md`, and must agree with the JAX engine.
"""
