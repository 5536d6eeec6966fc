"""ROS 2 definitions of the messages in a recording; every file stores these texts.

Fields are ordered so that CDR needs no padding. A changed text, even in a comment, is another format.
"""

from __future__ import annotations

ODOMETRY = """float64 time        # s, on the recording's own clock
float64 dx          # motion since the sample before, in the body frame before it: forward, m
float64 dy          # left, m
float64 dtheta      # counter-clockwise, rad
float64 dt          # the motion's duration, s
"""
SCHEMAS = {
    "ratslam_msgs/msg/Observation": ODOMETRY
    + """float64[2] wall_point  # its nearest point, m in base_link, if wall
float64 wall_sd     # standard deviation of the wall's direction, rad
int32 motion        # 0 other, 1 forward, 2 back, 3 turn
int32 label         # place id given with the recording, -1 none
uint32[3] view_shape  # rows, columns, channels
float64[] view      # row-major, in 0..1, if view_seen
uint32 whiskers
float64[] point     # whiskers x 2, m in base_link, where contact
uint8[] flags       # of each whisker; bit 0: it touched something, bit 1: it is dead
bool view_seen
bool wall           # whether a wall's orientation was measured
""",
    "ratslam_msgs/msg/Cycle": ODOMETRY
    + """uint32 samples
float64[] sample_time  # samples, s
uint32 whiskers
float64[] angle     # samples x whiskers, rad
uint32 axes         # 2
float64[] deflection  # samples x whiskers x 2
""",
    "ratslam_msgs/msg/Whisk": ODOMETRY
    + """uint32 whiskers
float64[] felt      # whiskers x 3: angle at first contact, rad; largest angle, rad; share of the shaft
uint8[] flags       # of each whisker; bit 0: it reports, bit 1: it touched, bit 2: it did so to the end
""",
    "ratslam_msgs/msg/Report": ODOMETRY
    + """int32 motion        # 0 other, 1 forward, 2 back, 3 turn
int32 moment        # how the step ended: 0 as planned, 1 first contact, 2 a second one, 3 strained too much
uint32 whiskers
float64[] sample_time  # samples, s since the beginning of the step
uint32 axes         # 2
float64[] strain    # samples x whiskers x 2
uint8[] flags       # of each whisker; bit 0: it reports, bit 1: it touches something
""",
    "ratslam_msgs/msg/Truth": """float64 time        # s, as in the reading it belongs to
float64 x           # m
float64 y           # m
float64 heading     # rad
""",
    "ratslam_msgs/msg/Cut": ODOMETRY
    + """float64 start       # when the whisk began, s
int64 number        # of the whisk
int64 first         # sequence of its first frame
int64 last          # of its last one
uint32 frames       # how many from first to last stand before this message
bool seen           # whether they became an image; false: only the motion counts
""",
    "ratslam_msgs/msg/Frames": """float64 time        # s, when the newest of them came
uint32 frames
int64[] sequence    # frames; the first, then differences
uint32 whiskers
int64[] device_time # frames, us; likewise
uint32 channels     # 3: angle, x and y of the deflection
uint32[] flags      # of each; bit 0: others were lost before it, 1: feedback, 2: fault, 3: a whisk begins
int16[] values      # whiskers x channels x frames; the first, then differences modulo 2^16; pi / 32768 rad
""",
    "ratslam_msgs/msg/Arm": """float64 time        # s, when the newest of them came
uint32 states
int64[] counter     # states
uint32 numbers      # 26
float64[] number    # 26 x states: receipt, robot's time, s; 6 each: tool pose, speed, force, joints
uint32 words        # 5
int32[] word        # 5 x states: robot mode, safety bits, runtime state, operation, progress
""",
    "ratslam_msgs/msg/Event": """float64 time        # s
string event        # its name, ': ', what was found
""",
}
(OBSERVATION, CYCLE, WHISK, REPORT, TRUTH, CUT, FRAMES, ARM, EVENT) = SCHEMAS
READINGS = (OBSERVATION, CYCLE, WHISK, REPORT, CUT)
"""Messages that make a sample."""
TOPICS = {
    OBSERVATION: "/ratslam/observation",
    CYCLE: "/ratslam/cycle",
    WHISK: "/ratslam/whisk",
    REPORT: "/ratslam/report",
    TRUTH: "/ratslam/truth",
    CUT: "/ratslam/cut",
    FRAMES: "/ratslam/frames",
    ARM: "/ratslam/arm",
    EVENT: "/ratslam/event",
}
SCHEMA_OF = {topic: name for name, topic in TOPICS.items()}
