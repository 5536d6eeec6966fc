"""Settings that fit a scene, and the cost of each cheaper one."""
