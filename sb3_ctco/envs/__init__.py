"""Environments of sb3-ctco, registered with Gymnasium when the package is imported."""

from typing import Any

import gymnasium as gym

#: Domains and tasks of dm_control's suite, spelled out so that registering them does not import dm_control.
DM_CONTROL_TASKS: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "lqr": ("lqr_2_1", "lqr_6_2"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}

#: Tasks of the paper's frequency study, in episodes of 10 s, and its interaction frequencies in Hz.
STUDY_TASKS: dict[str, dict[str, Any]] = {
    "point_mass-sparse": {"domain": "point_mass", "task": "easy", "sparse": True},
    "cheetah-run": {"domain": "cheetah", "task": "run"},
    "ball_in_cup-catch": {"domain": "ball_in_cup", "task": "catch"},
}
STUDY_RATES = (50, 100, 250, 500)


def register_envs() -> None:
    """Register dm_control's suite, the paper's settings and visual reaching with Gymnasium; once is enough.

    ``sb3_ctco/<domain>-<task>-v0`` is each task of the suite, and ``sb3_ctco/<study task>-<rate>hz-v0`` each task of the
    paper's study at each of its frequencies, for tools that know an environment by its id alone.
    """
    ids: dict[str, dict[str, Any]] = {
        f"sb3_ctco/{domain}-{task}-v0": {"domain": domain, "task": task}
        for domain, tasks in DM_CONTROL_TASKS.items()
        for task in tasks
    }
    for name, kwargs in STUDY_TASKS.items():
        for rate in STUDY_RATES:
            ids[f"sb3_ctco/{name}-{rate}hz-v0"] = {**kwargs, "dt": 1.0 / rate, "time_limit": 10.0}
    for env_id, kwargs in ids.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point="sb3_ctco.envs.dm_control:DMControlEnv", kwargs=kwargs)
    for difficulty in ("easy", "hard"):
        env_id = f"sb3_ctco/visual_reacher-{difficulty}-v0"
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="sb3_ctco.envs.visual_reacher:VisualReacherEnv",
                kwargs={"difficulty": difficulty, "time_limit": 8.0},
            )
