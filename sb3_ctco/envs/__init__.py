"""Environments of sb3-ctco, registered with Gymnasium when the package is imported."""

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


def register_envs() -> None:
    """Register dm_control's tasks as ``sb3_ctco/<domain>-<task>-v0``, and visual reaching; once is enough."""
    for domain, tasks in DM_CONTROL_TASKS.items():
        for task in tasks:
            env_id = f"sb3_ctco/{domain}-{task}-v0"
            if env_id not in gym.registry:
                gym.register(
                    env_id,
                    entry_point="sb3_ctco.envs.dm_control:DMControlEnv",
                    kwargs={"domain": domain, "task": task},
                )
    for difficulty in ("easy", "hard"):
        env_id = f"sb3_ctco/visual_reacher-{difficulty}-v0"
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="sb3_ctco.envs.visual_reacher:VisualReacherEnv",
                kwargs={"difficulty": difficulty},
            )
