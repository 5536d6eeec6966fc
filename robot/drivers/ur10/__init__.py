"""A UR-10 that carries the whisker head: supervised motion, states in shared memory."""
