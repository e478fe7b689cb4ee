"""Gradient updates a second, against Stable-Baselines3's SAC with the same networks, batch and optimizer.

    python benchmarks/updates.py

Both have a full replay buffer of ball in cup; one thread; the two take turns, and the median of the repeats counts.
"""

import argparse
import statistics
import time

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

import sb3_ctco
from benchmarks.markdown import table

SIZES = {
    "10-10 / 64-64, batch 100 (the paper's)": ({"pi": [10, 10], "qf": [64, 64]}, 100),
    "64-64 / 128-128, batch 100": ({"pi": [64, 64], "qf": [128, 128]}, 100),
    "256-256, batch 256 (SAC's)": ({"pi": [256, 256], "qf": [256, 256]}, 256),
}
