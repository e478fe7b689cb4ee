"""Interrupt a training, and go on in another process as if nothing had happened."""

import io
import pathlib
import pickle
import random
from collections.abc import Iterator
from typing import Any, TypeVar

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.utils import EzPickle
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_ctco.common.files import replace_durably

SelfAlgorithm = TypeVar("SelfAlgorithm", bound=BaseAlgorithm)

#: Attributes that Stable-Baselines3 saves, but that setting up a loaded model begins anew
_BEGUN_ANEW = ("_last_options", "_durations_since_log", "_residuals_since_log")
#: Attributes of VecEnvs that belong to where they are in, not to what they have seen
_NOT_STATE = ("venv", "class_attributes")


def save_checkpoint(model: BaseAlgorithm, path: str | pathlib.Path) -> None:
    """Save all that a training goes on from, between two calls of ``learn``.

    That is the model with its optimisers, the replay buffer, the environments in the middle of their episodes, and the
    generators of random numbers of torch, numpy, Python, the environments and their spaces.

    :param model: of this package or of Stable-Baselines3
    :param path: of the file, which is replaced once the new one is complete; it is a pickle, see :func:`load_checkpoint`
    :raises ValueError: if the environments' state cannot be saved: they are in other processes, or pickle cannot copy
        them or makes them anew (Gymnasium's ``EzPickle``, as its MuJoCo robots are); or of a ``HerReplayBuffer``
    """
    env = model.get_env()
    if env is None:
        raise ValueError("the model has no environment: a checkpoint is of a training, use save for a model alone")
    if isinstance(getattr(model, "replay_buffer", None), HerReplayBuffer):
        raise ValueError("a HerReplayBuffer, which computes rewards with the environment, cannot be saved to go on bit by bit")
    archive = io.BytesIO()
    model.save(archive)
    try:
        # In one pickle, since layers may share what they hold.
        environment = cloudpickle.dumps([_state(layer) for layer in _layers(env)])
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        raise ValueError(f"the state of the environments cannot be saved: {error}") from error
    state = {
        "algorithm": type(model).__qualname__,
        "model": archive.getvalue(),
        "attributes": {name: getattr(model, name) for name in _BEGUN_ANEW if hasattr(model, name)},
        "replay_buffer": getattr(model, "replay_buffer", None),
        "environment": environment,
        "generators": _generators(model, env),
    }
    path = pathlib.Path(path)
    unfinished = path.with_name(f"{path.name}.unfinished")
    with unfinished.open("wb") as file:
        cloudpickle.dump(state, file, protocol=pickle.HIGHEST_PROTOCOL)
    replace_durably(unfinished, path)


def load_checkpoint(
    algorithm: type[SelfAlgorithm], path: str | pathlib.Path, env: GymEnv, device: th.device | str = "auto"
) -> SelfAlgorithm:
    """A model that goes on with ``learn(..., reset_num_timesteps=False)`` bit by bit as the one that was saved would have.

    On the same machine with the same versions and number of threads, that is. Loading runs code that the file names:
    load files of your own only.

    :param algorithm: the class of the model
    :param path: of a file of :func:`save_checkpoint`
    :param env: made as the model's was; its single environments are replaced by those in the file
    :param device: to go on on
    :raises ValueError: if ``env`` has other layers or another number of environments, or the model is of another class
    """
    with pathlib.Path(path).open("rb") as file:
        state = pickle.load(file)
    saved_by = state.get("algorithm", algorithm.__qualname__)
    if saved_by != algorithm.__qualname__:
        raise ValueError(f"{path} is a checkpoint of {saved_by}: load it with that class, not with {algorithm.__qualname__}")
    model = algorithm.load(io.BytesIO(state["model"]), env=env, device=device, force_reset=False)
    for name, value in state["attributes"].items():
        setattr(model, name, value)
    if state["replay_buffer"] is not None:
        model.replay_buffer = state["replay_buffer"]  # type: ignore[attr-defined]
        model.replay_buffer.device = model.device  # type: ignore[attr-defined]
    vec_env = model.get_env()
    assert vec_env is not None
    layers, saved = [*_layers(vec_env)], pickle.loads(state["environment"])
    names, saved_names = [type(layer).__name__ for layer in layers], [one["class"] for one in saved]
    if names != saved_names or vec_env.num_envs != saved[0]["attributes"]["num_envs"]:
        raise ValueError(
            f"the environment is {vec_env.num_envs} in {names}, the checkpoint's is {saved[0]['attributes']['num_envs']} in "
            f"{saved_names}: make it as it was made when the training began"
        )
    for layer, one in zip(layers, saved, strict=True):
        vars(layer).update(one["attributes"])
    _set_generators(model, vec_env, state["generators"])
    return model


def _layers(env: VecEnv) -> Iterator[VecEnv]:
    """A VecEnv, and all that it wraps."""
    yield env
    while isinstance(env, VecEnvWrapper):
        env = env.venv
        yield env


def _state(layer: VecEnv) -> dict[str, Any]:
    """What a VecEnv, without those that it wraps, is made of."""
    if not isinstance(layer, VecEnvWrapper):
        if not isinstance(layer, DummyVecEnv):
            raise ValueError(
                f"the state of environments in a {type(layer).__name__} cannot be saved, it is in other processes: use "
                "DummyVecEnv, or begin with a reset (save, save_replay_buffer and load)"
            )
        for env in layer.envs:
            _refuse_made_anew(env)
    attributes = {name: value for name, value in vars(layer).items() if name not in _NOT_STATE}
    return {"class": type(layer).__name__, "attributes": attributes}


def _refuse_made_anew(env: gym.Env) -> None:
    while True:
        if isinstance(env, EzPickle):
            raise ValueError(
                f"the state of {env} cannot be saved: as an EzPickle it is made anew by pickle, at the beginning of an "
                "episode. Begin with a reset (save, save_replay_buffer and load)"
            )
        if not isinstance(env, gym.Wrapper):
            return
        env = env.env


def _generators(model: BaseAlgorithm, env: VecEnv) -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        # Setting up a loaded model seeds these anew.
        "model's actions": model.action_space.np_random,
        "environment's actions": env.action_space.np_random,
    }


def _set_generators(model: BaseAlgorithm, env: VecEnv, states: dict[str, Any]) -> None:
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if th.cuda.is_available() and states["cuda"]:
        th.cuda.set_rng_state_all(states["cuda"])
    model.action_space._np_random = states["model's actions"]
    env.action_space._np_random = states["environment's actions"]
