"""Pokes of another program in bags of a wrench and the pose of the tool."""

import numpy as np
import pytest

from robot.recordings.bags.topics_config import WrenchTopic
from robot.recordings.bags.wrench_pokes import PokeReader
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import SimulationConfig
from robot.world.contact_force import force_error
from tactile.base.se2 import compose, integrate, rotate
from tactile.pokes import PokeConfig, poke_angles
from tests.helpers.ros_bags import Entry, header, pose
