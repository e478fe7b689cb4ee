"""Recorded trajectories of others, as :meth:`~sb3_ctco.common.buffers.OptionReplayBuffer.add_trajectory` takes them.

::

    for trajectory in minari_trajectories("pendulum/sac-v0", dt=0.05):
        print(model.replay_buffer.add_trajectory(*trajectory))
"""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_ctco.options import Stacked


class RecordedTrajectory(NamedTuple):
    """An episode, or a part of one, of primitive actions.

    :param observations: ``[n + 1, *observation_shape]``, in the end the one after the last action; or a dictionary of such
    :param actions: in the units of the environment, ``[n, *action_shape]``
    :param rewards: ``[n]``
    :param terminated: whether the episode terminated with the last action
    :param truncated: whether it was truncated with it
    :param dt: time from one action to the next, in s
    """

    observations: Stacked
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool
    truncated: bool
    dt: float


def minari_trajectories(dataset: Any, dt: float) -> Iterator[RecordedTrajectory]:
    """The episodes of a Minari dataset.

    :param dataset: the name of one on this machine, or a ``minari.MinariDataset``
    :param dt: the interaction period of the environment that it was recorded in, in s: the dataset does not tell
    :raises ImportError: for a name, without minari
    """
    if isinstance(dataset, str):
        try:
            import minari
        except ImportError as error:
            raise ImportError("reading a Minari dataset needs minari: in a clone, pip install '.[minari]'") from error
        dataset = minari.load_dataset(dataset)
    for episode in dataset.iterate_episodes():
        ended = bool(episode.terminations[-1]), bool(episode.truncations[-1])
        yield RecordedTrajectory(episode.observations, episode.actions, np.asarray(episode.rewards), *ended, dt)


def lerobot_trajectories(
    folder: str | Path,
    observation: str | Mapping[str, str] = "observation.state",
    reward: Callable[[Stacked, np.ndarray], Any] | None = None,
    terminates: bool = True,
) -> Iterator[RecordedTrajectory]:
    """The episodes of a LeRobot dataset (versions 2 and 3 of its format), from the numbers in its Parquet files.

    Such an episode has an observation and an action a frame, and no observation after its last action. If it terminated
    there, that one is never used, and the last frame's stands in for it. If it did not, its last action is left out.

    :param folder: of the dataset, with ``meta/info.json``, which tells its frames per second, and ``data``
    :param observation: the column that the environment observes, or columns by the keys of its dictionary of observations
    :param reward: rewards ``[n]`` of the observations ``[n + 1, …]`` and actions ``[n, action_dim]`` of an episode; by default
        the column ``next.reward``
    :param terminates: whether an episode whose last ``next.done`` is true terminated; False if time was up
    :raises ImportError: without pyarrow
    :raises FileNotFoundError: if the folder holds no such dataset
    :raises ValueError: if a column is missing, or is a video or an image, which are no numbers in these files
    """
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError("reading a LeRobot dataset needs pyarrow: in a clone, pip install '.[lerobot]'") from error
    info = Path(folder) / "meta" / "info.json"
    files = sorted((Path(folder) / "data").glob("chunk-*/*.parquet"))
    if not info.exists() or not files:
        raise FileNotFoundError(f"{folder} is no LeRobot dataset: it needs meta/info.json and data/chunk-000/*.parquet")
    dt = 1.0 / float(json.loads(info.read_text())["fps"])
    columns = {"": observation} if isinstance(observation, str) else dict(observation)
    for file in files:
        table = parquet.read_table(file)
        numbers = {name: _numbers(table, name, file) for name in ("episode_index", "frame_index", "action", *columns.values())}
        others = {name: _numbers(table, name, file) for name in ("next.reward", "next.done") if name in table.column_names}
        if reward is None and "next.reward" not in others:
            raise ValueError(f"{file} has no column next.reward: pass reward, a function of observations and actions")
        for episode in np.unique(numbers["episode_index"]):
            rows = np.flatnonzero(numbers["episode_index"][:, 0] == episode)
            rows = rows[numbers["frame_index"][rows, 0].argsort(kind="stable")]
            terminated = terminates and "next.done" in others and bool(others["next.done"][rows[-1], 0])
            acted = rows if terminated else rows[:-1]
            if not len(acted):
                continue  # of one frame: nothing was done
            seen = np.append(rows, rows[-1]) if terminated else rows
            stacked = {key: numbers[name][seen] for key, name in columns.items()}
            observations: Stacked = stacked[""] if isinstance(observation, str) else stacked
            actions = numbers["action"][acted]
            rewards = others["next.reward"][acted, 0] if reward is None else reward(observations, actions)
            yield RecordedTrajectory(observations, actions, np.asarray(rewards), terminated, not terminated, dt)


def _numbers(table: Any, name: str, file: Path) -> np.ndarray:
    """A column of a Parquet file, one row a frame: ``[n, size]``."""
    if name not in table.column_names:
        raise ValueError(f"{file} has no column {name}, and has {table.column_names}: videos and images cannot be read")
    values = np.vstack(table[name].to_numpy())
    if values.dtype == object:
        raise ValueError(f"column {name} of {file} is no vector of numbers but {table[name].type}")
    return values
