"""The base of off-policy algorithms that decide by options: environments, replay buffer, time accounting."""

import dataclasses
import io
import json
import math
import pathlib
import warnings
import zipfile
from collections import deque
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    Schedule,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
    unwrap_vec_normalize,
    unwrap_vec_wrapper,
)

from sb3_ctco.common.buffers import DictOptionReplayBuffer, OptionReplayBuffer, refuse_normalised_rewards
from sb3_ctco.common.callbacks import WithinRollout, as_callback, eval_callbacks, in_primitive_steps, wrap_each
from sb3_ctco.common.load_arguments import check_load_arguments
from sb3_ctco.option_array import OptionArray
from sb3_ctco.options import (
    OPTIONS_OF_0_1_0,
    PLAYED,
    DurationScale,
    Join,
    OptionSpace,
    RewardUnit,
    Trajectory,
    discount_rate_from_gamma,
)
from sb3_ctco.vec_env import AsyncOptionVecEnv
from sb3_ctco.wrappers import OptionExecutionWrapper, find_dt

#: Of how many decisions logs tell at most
_MAX_LOGGED = 100_000
#: Arguments for which None stands for what is found in the environment, or follows from others
_FOUND = ("dt", "d_max", "d_min", "n_repetitions")

SelfOptionOffPolicyAlgorithm = TypeVar("SelfOptionOffPolicyAlgorithm", bound="OptionOffPolicyAlgorithm")


class OptionOffPolicyAlgorithm(OffPolicyAlgorithm):
    """Stable-Baselines3's ``OffPolicyAlgorithm`` on the semi-Markov decision process of options.

    A bare environment is wrapped in :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`; the settings of one that is
    wrapped already must agree with the algorithm's. Every number of steps that a user gives or sees
    (``total_timesteps``, ``num_timesteps``, ``learning_starts``, ``train_freq``, callbacks, logs, schedules) counts
    primitive environment steps.

    Parameters that ``OffPolicyAlgorithm`` has are documented there; these differ or are further:

    :param n_rbf: number of weights an action dimension
    :param d_max: longest duration of an option, in s
    :param d_min: shortest duration, in s, by default what ``OptionExecutionWrapper`` has; 0 for one step of the environment
    :param dt: the environment's interaction period, in s; by default found in the environment
    :param trajectory: how ω becomes actions, a name in ``sb3_ctco.options.TRAJECTORIES`` or a class
    :param duration_scale: ``"log"`` or ``"linear"``, see :class:`~sb3_ctco.options.OptionSpace`
    :param join: ``"free"``, ``"continuous"`` or ``"smooth"``, see :class:`~sb3_ctco.wrappers.OptionExecutionWrapper`
    :param gamma: discount factor over ``gamma_dt`` seconds, in (0, 1]
    :param gamma_dt: in s
    :param train_freq: collect at least this many primitive steps (in each environment) between trainings
    :param gradient_steps: updates per training; -1 for as many as primitive steps were collected
    :param updates_per_second: updates per second of task time, the paper's "fixed number of updates per time unit",
        in place of ``gradient_steps``; a fraction is carried over
    :param n_sub_options: how many random stretches of each option, at most, go into the replay buffer beside it;
        environments that are wrapped already are told
    :raises ValueError: for settings out of range or contradicting each other or the environment's
    """

    #: Arguments that ``load`` cannot change: what options mean; subclasses add what was learned or decides what is saved
    _kept_when_loaded: ClassVar[tuple[str, ...]] = (
        "n_rbf",
        "d_max",
        "d_min",
        "trajectory",
        "duration_scale",
        "join",
    )
    #: An attribute that this class's files have and others' have not
    _own_setting: ClassVar[str] = "discount_rate"

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule,
        *,
        n_rbf: int,
        d_max: float,
        d_min: float | None,
        dt: float | None,
        trajectory: str | type[Trajectory] = "bezier",
        duration_scale: DurationScale = "log",
        join: Join = "free",
        gamma: float,
        gamma_dt: float,
        updates_per_second: float | None,
        gradient_steps: int,
        n_sub_options: int = 0,
        verbose: int = 0,
        **kwargs: Any,
    ):
        self.n_rbf = n_rbf
        self.d_max = d_max
        self.d_min = d_min
        self.dt = dt
        self.trajectory = trajectory
        self.duration_scale: DurationScale = duration_scale
        self.join: Join = join
        self.gamma = gamma
        self.gamma_dt = gamma_dt
        # An explicit dt stays the user's word on any environment; one that was found must be found again.
        self._dt_was_given = dt is not None
        #: τ, in 1/s
        self.discount_rate = discount_rate_from_gamma(gamma, gamma_dt)
        _refuse_both(updates_per_second, gradient_steps)
        self.updates_per_second = updates_per_second
        self.n_sub_options = n_sub_options
        #: Of the latest decisions since logs were written
        self._residuals_since_log: deque[float] = deque(maxlen=_MAX_LOGGED)
        self._durations_since_log: deque[float] = deque(maxlen=_MAX_LOGGED)
        #: The action space of the bare environment, and the unit of its rewards; None until there is an environment.
        self.primitive_action_space: spaces.Box | None = None
        self.reward_unit: RewardUnit | None = None
        self._updates_due = 0.0
        #: How often the environments had been called when learning ended
        self._env_calls: list[int] | None = None

        if env is not None:
            env = self._as_option_env(maybe_make_env(env, verbose))
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            gamma=gamma,
            gradient_steps=gradient_steps,
            verbose=verbose,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
            **kwargs,
        )

    @property
    def option_space(self) -> OptionSpace:
        """What the policy's option vectors mean.

        :raises ValueError: before ``dt`` and ``d_min`` are known, that is without an environment
        """
        if self.dt is None or self.d_min is None:
            raise ValueError(
                f"dt={self.dt} s and d_min={self.d_min} s are found in an environment, and {type(self).__name__} has not "
                "had one: pass it env, or dt and d_min"
            )
        return OptionSpace.make(**{**self._option_arguments, "d_min": self.d_min or self.dt})

    @property
    def _option_arguments(self) -> dict[str, Any]:
        """OptionExecutionWrapper's arguments for the same options, ``dt`` and ``d_min`` as far as they are known."""
        names = ("n_rbf", "d_max", "d_min", "dt", "trajectory", "duration_scale", "join", "discount_rate")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def wrapper_kwargs(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        """OptionExecutionWrapper's arguments for the algorithm's, where environments are made before it.

        :param arguments: the algorithm's arguments, defaults included
        """
        names = ("n_rbf", "d_max", "d_min", "dt", "trajectory", "duration_scale", "join", "n_sub_options")
        kwargs = {name: arguments[name] for name in names if name in arguments}
        return {**kwargs, "discount_rate": discount_rate_from_gamma(arguments["gamma"], arguments["gamma_dt"])}

    def wrap_env(self, env: gym.Env, n_sub_options: int = 0) -> OptionExecutionWrapper:
        """Wrap a bare environment as the algorithm wraps its own, for instance to evaluate in it.

        :param env: the bare environment
        :param n_sub_options: sub-options are for learning, so none by default
        :return: ``OptionExecutionWrapper(Monitor(env))``, a Monitor being added where there is none
        """
        dt = self.dt if self._dt_was_given else (find_dt(env) or self.dt)
        if unwrap_wrapper(env, Monitor) is None:
            env = Monitor(env)
        arguments = {**self._option_arguments, "dt": dt, "reward_unit": self.reward_unit or "rate"}
        return OptionExecutionWrapper(env, **arguments, n_sub_options=n_sub_options)

    def _as_option_env(self, env: GymEnv) -> GymEnv:
        if isinstance(env, VecEnv):
            if not all(env.env_is_wrapped(OptionExecutionWrapper)):
                raise ValueError(
                    f"{type(self).__name__} cannot wrap the environments of a VecEnv from outside: make it with "
                    "make_vec_env(..., wrapper_class=OptionExecutionWrapper, wrapper_kwargs=dict(n_rbf=..., d_max=...)). "
                    "With RL Zoo, the command sb3-ctco in the place of python -m rl_zoo3 does so"
                )
            _warn_of_outer_monitors(env)
            return env
        _warn_of_outer_monitors(env)
        wrapped = unwrap_wrapper(env, OptionExecutionWrapper)
        if wrapped is None:
            return self.wrap_env(env, self.n_sub_options)
        if unwrap_wrapper(env, Monitor) is None:
            # Inside, where it counts primitive steps; Stable-Baselines3 would put it outside.
            wrapped.env = Monitor(wrapped.env)  # type: ignore[attr-defined]
        return env

    def _as_eval_env(self, env: VecEnv) -> VecEnv:
        """The environment of an EvalCallback, which made a ``DummyVecEnv`` of the one that it was given."""
        if not all(env.env_is_wrapped(OptionExecutionWrapper)):
            if type(env) is not DummyVecEnv:
                raise ValueError(
                    f"EvalCallback evaluates in a {type(env).__name__} of environments that do not play options: pass it "
                    "model.wrap_env(env), or make it with make_vec_env(..., wrapper_class=OptionExecutionWrapper, "
                    "wrapper_kwargs=dict(n_rbf=..., d_max=...))"
                )
            env = wrap_each(env, self.wrap_env)
        _warn_of_outer_monitors(env)
        self._check_settings(env)
        return env

    def _check_env(self, env: VecEnv) -> OptionSpace:
        """The options' space of an environment, once they agree with the algorithm's."""
        refuse_normalised_rewards(unwrap_vec_normalize(env))
        if self.n_sub_options and unwrap_vec_wrapper(env, VecFrameStack) is not None:
            raise ValueError(
                "sub-options begin at single observations, which VecFrameStack does not stack: stack frames inside, with "
                "gymnasium.wrappers.FrameStackObservation, or pass n_sub_options=0"
            )
        if isinstance(env.unwrapped, AsyncOptionVecEnv):
            wrapper = env
            while isinstance(wrapper, VecEnvWrapper):
                if not isinstance(wrapper, VecTransposeImage):
                    raise ValueError(
                        f"{type(wrapper).__name__} would count an observation again while the option that began with it "
                        "runs on in AsyncOptionVecEnv: use SubprocVecEnv, or a Gymnasium wrapper inside"
                    )
                wrapper = wrapper.venv
        return self._check_settings(env)

    def _adopt_env(self, env: VecEnv) -> None:
        """Take over what an environment that was checked says, and tell it what is wanted of it."""
        self.primitive_action_space = env.get_attr("primitive_action_space")[0]
        self.reward_unit = env.get_attr("reward_unit")[0]
        if env.get_attr("overrides_dt")[0]:
            # The user's word to the wrapper
            self._dt_was_given = True
        env.env_method("set_n_sub_options", self.n_sub_options)
        self._tell_buffer()

    def _check_settings(self, env: VecEnv) -> OptionSpace:
        """The options' settings of an environment, once options mean the same in it as to the algorithm."""
        settings: list[OptionSpace] = env.get_attr("option_space")
        known = {name: value for name, value in self._option_arguments.items() if value is not None}
        known = {**settings[0].arguments, **known}
        expected = OptionSpace.make(**{**known, "d_min": known["d_min"] or known["dt"]})
        for one in settings:
            for name, (value, found) in expected.differences(one).items():
                hint = ""
                if name == "dt" and "dt" in self._kept_when_loaded:
                    hint = ". To evaluate at another rate, pass the environment as wrap_env(env) has it"
                elif name == "dt":
                    hint = f", or pass dt={found} to load, where options last as long at another rate"
                raise ValueError(
                    f"the environment's options have {name}={found}, {type(self).__name__} has "
                    f"{name}={value}: give both the same (discount_rate is -ln(gamma)/gamma_dt){hint}"
                )
        units: list[RewardUnit] = env.get_attr("reward_unit")
        for unit in units:
            if unit != (self.reward_unit or units[0]):
                raise ValueError(
                    f"the environment's rewards have reward_unit={unit!r}, {type(self).__name__} learned from "
                    f"{self.reward_unit or units[0]!r}: give both the same"
                )
        action_spaces: list[spaces.Box] = env.get_attr("primitive_action_space")
        for space in action_spaces:
            if space != (self.primitive_action_space or action_spaces[0]):
                raise ValueError(
                    f"the environment's actions are in {space}, {type(self).__name__} learned actions in "
                    f"{self.primitive_action_space or action_spaces[0]}: options mean the same in both only if these agree"
                )
        return settings[0]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Stable-Baselines3's ``set_env``; a bare environment is wrapped with the algorithm's settings.

        :raises ValueError: if the settings of an environment that is wrapped already differ from the algorithm's
        """
        env = self._wrap_env(self._as_option_env(env), self.verbose)
        self._check_env(env)
        super().set_env(env, force_reset)
        self._adopt_env(env)

    @classmethod
    def load(
        cls: type[SelfOptionOffPolicyAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfOptionOffPolicyAlgorithm:
        """Stable-Baselines3's ``load``; a bare environment is wrapped with the settings in the file.

        :param kwargs: arguments of the constructor to change, such as ``learning_rate``, ``buffer_size`` or ``gamma``; not
            those that options or networks depend on (such as ``n_rbf``, ``d_max``, ``d_min``, ``policy_kwargs``), and
            not the temperatures, which are learned and saved
        :raises TypeError: for an argument that the constructor does not have
        :raises ValueError: if the environment's settings differ from the file's, for an argument that cannot be changed, or if
            another algorithm wrote the file
        """
        saved = cls._saved_attributes(path)
        older = cls._arguments_of_older_files(saved) if saved else {}
        # What the constructor finds by itself is as without it.
        kwargs = {name: value for name, value in kwargs.items() if value is not None or name not in _FOUND}
        if kwargs.get("d_min") == 0.0:
            kwargs["d_min"] = saved.get("dt")  # as which it was saved
        # With a target rate β_h is learned, and the file has it.
        learned = ["high_freq_penalty"] if saved.get("target_decision_rate") is not None else []
        kwargs = {**older, **check_load_arguments(cls, path, kwargs, [*cls._kept_when_loaded, *learned], older)}
        if "replay_buffer_kwargs" in kwargs:
            given = kwargs["replay_buffer_kwargs"] or {}
            unit = saved.get("replay_buffer_kwargs", {}).get("reward_scale", 1.0)
            _check_unit(given.get("reward_scale", "auto"), unit)
            kwargs["replay_buffer_kwargs"] = {**given, "reward_scale": unit}
        # Of two that say the same in different ways, the one that is given holds.
        _refuse_both(kwargs.get("updates_per_second"), kwargs.get("gradient_steps", -1))
        if "gradient_steps" in kwargs:
            kwargs.setdefault("updates_per_second", None)
        elif kwargs.get("updates_per_second") is not None:
            kwargs["gradient_steps"] = -1
        if "dt" in kwargs:
            kwargs["_dt_was_given"] = True
        if env is not None:
            kwargs["n_envs"] = env.num_envs if isinstance(env, VecEnv) else 1
        model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        model._after_load()
        if env is not None:
            # Only now are the settings known that a bare environment is wrapped with.
            model.set_env(env, force_reset)
            if model.seed is not None:
                model.env.seed(model.seed)  # type: ignore[union-attr]
        return model

    @classmethod
    def _arguments_of_older_files(cls, saved: dict[str, Any]) -> dict[str, Any]:
        """Arguments that a file says nothing of because its version did not have them.

        :param saved: what the file says of the model's attributes
        """
        return {name: value for name, value in OPTIONS_OF_0_1_0.items() if name not in saved}

    def _after_load(self) -> None:
        """What is left to do when a file has been read; nothing here."""

    @classmethod
    def _saved_attributes(cls, path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, Any]:
        """What a file says of a model's attributes, as JSON; empty if it is no zip file.

        :raises ValueError: if another algorithm wrote it
        """
        file = open_path(path, "r", verbose=0, suffix="zip")
        attributes = json.loads(zipfile.ZipFile(file).read("data")) if zipfile.is_zipfile(file) else {}
        if file is path:
            file.seek(0)
        else:
            file.close()
        writer = attributes.get("policy_class", {}).get("__module__", "an unknown module")
        if attributes and cls._own_setting not in attributes:
            raise ValueError(
                f"{path} was not saved by {cls.__name__}: its policy is from {writer}. Load it with the class that saved it"
            )
        return attributes

    def _setup_model(self) -> None:
        if self.n_steps != 1:
            raise ValueError(f"n_steps={self.n_steps} is not supported: an option is a return over several steps already")
        if self.optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported with options, see OptionReplayBuffer")
        if self.replay_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.replay_buffer_class = DictOptionReplayBuffer if is_dict else OptionReplayBuffer
        elif not issubclass(self.replay_buffer_class, OptionReplayBuffer | DictOptionReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must be OptionReplayBuffer, DictOptionReplayBuffer or a subclass, not "
                f"{self.replay_buffer_class.__name__}, which does not keep the durations of options"
            )
        if self.updates_per_second is not None and not 0 < self.updates_per_second < math.inf:
            raise ValueError(f"updates_per_second must be positive or None, not {self.updates_per_second}")
        # Once more, since load may have changed gamma.
        self.discount_rate = discount_rate_from_gamma(self.gamma, self.gamma_dt)
        self.replay_buffer_kwargs = {"reward_scale": 1.0, **self.replay_buffer_kwargs, "discount_rate": self.discount_rate}
        if self.env is not None:
            space = self._check_env(self.env)
            self.dt, self.d_min = space.dt, space.d_min
        super()._setup_model()
        train_freq: Any = self.train_freq  # a TrainFreq by now
        if train_freq.frequency < 1:
            raise ValueError(f"train_freq must be at least 1, not {train_freq.frequency}")
        if self.env is None:
            self._tell_buffer()
        else:
            self._adopt_env(self.env)
        self._warn_of_a_large_buffer()

    def _tell_buffer(self) -> None:
        """Tell the replay buffer what options mean, for the trajectories that are added to it."""
        buffer = self.replay_buffer
        if isinstance(buffer, OptionReplayBuffer | DictOptionReplayBuffer) and None not in (self.dt, self.d_min):
            buffer.option_space, buffer.primitive_action_space = self.option_space, self.primitive_action_space
            buffer.reward_unit = self.reward_unit or "rate"

    def _warn_of_a_large_buffer(self) -> None:
        buffer, available = self.replay_buffer, _available_memory()
        if not isinstance(buffer, OptionReplayBuffer | DictOptionReplayBuffer) or available is None:
            return
        planned = buffer.bytes_per_transition * buffer.buffer_size
        if planned <= available:
            return
        decisions = buffer.buffer_size // (1 + self.n_sub_options)
        span = "" if self.d_min is None else f", {decisions * self.d_min:,.0f} to {decisions * self.d_max:,.0f} s of task time"
        warnings.warn(
            f"buffer_size={buffer.buffer_size:,} plans {planned / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are "
            f"available: pass a smaller one, {available // 2 // buffer.bytes_per_transition:,} for half of that. With "
            f"n_sub_options={self.n_sub_options} this buffer holds at least {decisions:,} decisions{span}",
            stacklevel=4,
        )

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Stable-Baselines3's; what is in the buffer is scaled as this algorithm scales rewards.

        :raises ValueError: if its options were discounted at another rate, or mean something else; the own buffer stays then
        """
        own = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            self._check_loaded_buffer(path)
        except BaseException:
            self.replay_buffer = own
            raise
        for name in {"reward_scale", "demonstration_fraction"} & self.replay_buffer_kwargs.keys():
            setattr(self.replay_buffer, name, self.replay_buffer_kwargs[name])
        self._tell_buffer()

    def _check_loaded_buffer(self, path: Any) -> None:
        buffer = self.replay_buffer
        if not isinstance(buffer, OptionReplayBuffer | DictOptionReplayBuffer):
            raise ValueError(f"{path} holds a {type(buffer).__name__}, which does not have the durations of options")
        if not math.isclose(buffer.discount_rate, self.discount_rate, rel_tol=1e-6):
            raise ValueError(
                f"the replay buffer in {path} has discount_rate={buffer.discount_rate}, {type(self).__name__} has "
                f"discount_rate={self.discount_rate}: load it into a model with the same gamma and gamma_dt"
            )
        if buffer.option_space is not None and None not in (self.dt, self.d_min):
            # At another rate options last as long.
            of_buffer = dataclasses.replace(buffer.option_space, dt=self.option_space.dt)
            differences = self.option_space.differences(of_buffer)
            for name in ("primitive_action_space", "reward_unit"):
                value, found = getattr(self, name), getattr(buffer, name)
                if None not in (value, found) and value != found:
                    differences[name] = value, found
            for name, (value, found) in differences.items():
                raise ValueError(
                    f"the options in the replay buffer in {path} have {name}={found}, {type(self).__name__} has "
                    f"{name}={value}: load it into a model with the same"
                )

    def go_on_from(self, learned: "OptionOffPolicyAlgorithm") -> None:
        """Take over what another model of this algorithm found in what it saw, beside what networks and optimizers hold.

        That is the unit of its critics' values, which ``"auto"`` would find anew.

        :raises ValueError: if this model was given another unit
        """
        unit = learned.replay_buffer_kwargs["reward_scale"]
        _check_unit(self.replay_buffer_kwargs["reward_scale"], unit)
        self.replay_buffer_kwargs["reward_scale"] = unit
        assert isinstance(self.replay_buffer, OptionReplayBuffer | DictOptionReplayBuffer)
        self.replay_buffer.reward_scale = unit

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callback = as_callback(callback)
        for evaluating in eval_callbacks(callback):
            evaluating.eval_env = self._as_eval_env(evaluating.eval_env)
        return super()._init_callback(in_primitive_steps(callback, progress_bar))

    def learn(
        self: SelfOptionOffPolicyAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOptionOffPolicyAlgorithm:
        """Learn for ``total_timesteps`` primitive steps, up to the end of the option that reaches them.

        Parameters are those of Stable-Baselines3's ``learn``; ``tb_log_name`` is the class's name by default.
        """
        name = type(self).__name__ if tb_log_name is None else tb_log_name
        if self.env is not None and self._was_moved(self.env):
            self._last_obs = None  # begin with a reset
        model = super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        assert self.env is not None
        self._env_calls = self.env.get_attr("n_calls")
        return model

    def _was_moved(self, env: VecEnv) -> bool:
        """Whether somebody else used the environment since it was learned in, to evaluate, or to learn with another model."""
        if any(n != self.n_sub_options for n in env.get_attr("n_sub_options")):
            env.env_method("set_n_sub_options", self.n_sub_options)
            return True
        return env.get_attr("n_calls") != self._env_calls

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last option may end after the last step that was asked for: schedules are of numbers from 1 to 0.
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        noise: Any = None if action_noise is None else lambda: self._noise_of_options(action_noise())
        return super()._sample_action(learning_starts, noise, n_envs)

    def _noise_of_options(self, noise: np.ndarray) -> np.ndarray:
        if np.shape(noise)[-1:] != self.action_space.shape:
            raise ValueError(
                f"action_noise has the shape {np.shape(noise)}: it is added to options, {self.action_space.shape} numbers (ω, "
                "then d), and not to actions"
            )
        return noise

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """Collect decisions until ``train_freq`` primitive steps (or episodes) are reached.

        :return: with the number of updates that are due as ``episode_timesteps``
        """
        start = self.num_timesteps
        by_step = train_freq.unit == TrainFrequencyUnit.STEP
        chunk = TrainFreq(1, TrainFrequencyUnit.STEP) if by_step else train_freq
        callback.on_rollout_start()
        within = WithinRollout(callback)
        while True:
            try:
                rollout = super().collect_rollouts(
                    env, within, chunk, replay_buffer, action_noise, learning_starts, log_interval
                )
            except BaseException:
                # The environment may have moved on without its transition being stored: begin with a reset.
                self._last_obs = None
                raise
            if not rollout.continue_training:
                self._last_obs = None
                break
            if not by_step or self.num_timesteps - start >= train_freq.frequency * self.n_envs:
                callback.on_rollout_end()
                break
        steps = self.num_timesteps - start
        if self.updates_per_second is not None:
            assert self.dt is not None
            trained_steps = self.num_timesteps - max(start, learning_starts)
            self._updates_due += max(trained_steps, 0) * self.dt * self.updates_per_second
            steps = int(self._updates_due)
            self._updates_due -= steps
        return rollout._replace(episode_timesteps=steps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_durations_since_log", "_residuals_since_log"]

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # A copy, since the caller's array may be the one that the environment is given.
        buffer_action = buffer_action.copy()
        for i, info in enumerate(infos):
            if PLAYED in info:
                buffer_action[i] = self.policy.scale_action(info[PLAYED])
        self._see_what_ran(buffer_action, infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        for info in infos:
            if "option" in info:
                self._durations_since_log.append(info["option"]["duration"])
            if "sub_options" in info:
                self._residuals_since_log.extend(info["sub_options"].residuals)

    def _see_what_ran(self, options: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Adapt options to what ran of them, in place, before they are stored; a subclass may need to.

        :param options: normalised, ``[n_envs, option_dim]``
        :param infos: each with ``info["option"]``, unless its option runs on
        """

    def dump_logs(self) -> None:
        """Write log data; also the durations of options, their mean and the decision rate since the last time."""
        if self._durations_since_log:
            duration = float(np.mean(self._durations_since_log))
            self.logger.record("option/duration_mean", duration)
            self.logger.record("option/decision_rate_hz", 1.0 / duration)
            # TensorBoard shows a tensor as a histogram; other formats cannot.
            durations = th.tensor([*self._durations_since_log])
            self.logger.record("option/duration", durations, exclude=("stdout", "log", "json", "csv"))
            self._durations_since_log.clear()
        if self._residuals_since_log:
            self.logger.record("option/slice_residual", float(np.mean(self._residuals_since_log)))
            self._residuals_since_log.clear()
        super().dump_logs()

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """The policy's *option* for an observation, not an action of the bare environment.

        Step the wrapped environment (``model.get_env()``, or :meth:`wrap_env` around your own) with it. A bare environment
        that takes it for an action gets an error that says so, see :class:`~sb3_ctco.option_array.OptionArray`.

        :return: the option ``[ω, d]``, shape ``[action_dim · n_rbf + 1]`` in [−1, 1] (with a leading axis for several
            observations), and None
        """
        options, state = super().predict(observation, state, episode_start, deterministic)
        return options.view(OptionArray), state


def _refuse_both(updates_per_second: float | None, gradient_steps: int) -> None:
    if updates_per_second is not None and gradient_steps != -1:
        raise ValueError(
            f"updates_per_second={updates_per_second} and gradient_steps={gradient_steps} both say how often to update: pass "
            "one of them"
        )


def _check_unit(given: float | str, unit: float | str) -> None:
    if given not in ("auto", unit):
        raise ValueError(
            f"reward_scale={given} cannot be changed while loading: the file's critics learned with reward_scale={unit}. "
            "Leave it out, or make a new model"
        )


def _available_memory() -> int | None:
    """Memory that can be had without swapping, in bytes, on Linux; elsewhere None, and Stable-Baselines3 asks psutil."""
    try:
        lines = pathlib.Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


def _warn_of_outer_monitors(env: GymEnv) -> None:
    """Warn of a Monitor that sees options, where a step of it is a decision."""
    outside: gym.Env | VecEnv | None = unwrap_vec_wrapper(env, VecMonitor) if isinstance(env, VecEnv) else env
    if isinstance(env, VecEnv) and outside is None and isinstance(env.unwrapped, DummyVecEnv):
        outside = env.unwrapped.envs[0]
    while isinstance(outside, gym.Wrapper) and not isinstance(outside, OptionExecutionWrapper | Monitor):
        outside = outside.env
    if isinstance(outside, Monitor | VecMonitor) and _plays_options(env):
        name = type(outside).__name__
        warnings.warn(
            f"{name} is outside OptionExecutionWrapper, so the episode lengths that it reports count decisions, not "
            "environment steps: use OptionExecutionWrapper(Monitor(env)), as model.wrap_env(env) and make_vec_env(..., "
            "wrapper_class=OptionExecutionWrapper) do",
            stacklevel=3,
        )


def _plays_options(env: GymEnv) -> bool:
    if isinstance(env, VecEnv):
        return all(env.env_is_wrapped(OptionExecutionWrapper))
    return unwrap_wrapper(env, OptionExecutionWrapper) is not None
