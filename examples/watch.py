"""Watch a trained policy: a video of an episode, and a plot of what it did and when it decided.

    python examples/watch.py model.zip --env Pendulum-v1
    MUJOCO_GL=egl python examples/watch.py model.zip --env sb3_ctco/ball_in_cup-catch-v0 --rate 50
    MUJOCO_GL=egl python examples/watch.py model.zip --env sb3_ctco/point_mass-easy-v0 --rate 500 --env-kwargs sparse:True

Needs pip install '.[render]' in the clone, and for MuJoCo without a display MUJOCO_GL=egl or osmesa. Writes episode.png
and episode-0.mp4 into --folder. The model is one that CTCO saved, or an exported .onnx; it drives the bare environment,
which --rate makes with another dt if the environment takes one. The video has --fps frames per second of task time,
whatever the rate.
"""

import argparse
import ast
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np

from sb3_ctco import OptionController
from sb3_ctco.video import RecordEpisodes
from sb3_ctco.wrappers import find_dt

mpl.use("Agg")
from matplotlib import pyplot as plt

BLUE, GREY = "#1f77b4", "0.75"


@dataclass
class Trace:
    """What happened, one entry a tick."""

    dt: float
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    decisions: list[bool] = field(default_factory=list)


def play(controller: OptionController, env: gym.Env, seed: int) -> Trace:
    trace = Trace(controller.dt)
    obs, _ = env.reset(seed=seed)
    controller.reset()
    done = False
    while not done:
        action = controller(obs)
        obs, reward, terminated, truncated, _ = env.step(action)
        trace.actions.append(np.ravel(action))
        trace.rewards.append(float(reward))
        trace.durations.append(controller.duration)
        trace.decisions.append(controller.elapsed == 0)
        done = terminated or truncated
    return trace


def plot(trace: Trace, title: str, path: Path) -> None:
    actions = np.array(trace.actions)
    time = np.arange(len(actions)) * trace.dt
    decided = np.flatnonzero(trace.decisions)
    n_actions = actions.shape[1]
    figure, axes = plt.subplots(
        n_actions + 2, 1, sharex=True, figsize=(9, 1.5 * (n_actions + 2) + 0.6), layout="constrained", squeeze=False
    )
    rows = axes[:, 0]
    for i, axis in enumerate(rows[:n_actions]):
        axis.plot(time, actions[:, i], color=BLUE, linewidth=1.2)
        axis.plot(time[decided], actions[decided, i], "o", color=BLUE, markersize=3.5)
        axis.set_ylabel("action" if n_actions == 1 else f"action {i + 1}")
    rows[-2].hlines(
        np.array(trace.durations)[decided], time[decided], np.append(time[decided[1:]], len(actions) * trace.dt), color=BLUE
    )
    rows[-2].set_ylabel("duration, s")
    rows[-2].set_ylim(bottom=0)
    rows[-1].plot(time, trace.rewards, color=BLUE, linewidth=1.2)
    rows[-1].set_ylabel("reward")
    rows[-1].set_xlabel("time, s")
    for axis in rows:
        axis.spines[["top", "right"]].set_visible(False)
        for second in time[decided]:
            axis.axvline(second, color=GREY, linewidth=0.5, zorder=0)
    rate = len(decided) / (len(actions) * trace.dt)
    rows[0].set_title(
        f"{title}: {1 / trace.dt:.0f} Hz control, {len(decided)} decisions ({rate:.1f} a second; dots and grey lines)",
        fontsize=10,
        loc="left",
    )
    rows[-1].set_xlim(0, len(actions) * trace.dt)
    figure.align_ylabels()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def key_and_value(text: str) -> tuple[str, Any]:
    """RL Zoo's ``key:value``, a Python literal or a string."""
    key, colon, value = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} is not key:value, such as sparse:True")
    try:
        return key, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        return key, value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="saved by CTCO (.zip), or exported (.onnx)")
    parser.add_argument("--env", required=True, help="Gymnasium id of the bare environment")
    parser.add_argument("--rate", type=float, help="control rate in Hz, for environments that take dt")
    parser.add_argument("--env-kwargs", nargs="+", type=key_and_value, default=[], help="key:value, as in RL Zoo")
    parser.add_argument("--fps", type=float, default=25.0, help="of the video")
    parser.add_argument("--vec-normalize", help="statistics that VecNormalize saved, if training normalised observations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", default="watch")
    parser.add_argument("--no-video", action="store_true")
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*GLFW.*")

    folder = Path(args.folder)
    kwargs = {**dict(args.env_kwargs), **({"dt": 1 / args.rate} if args.rate else {})}
    env = gym.make(args.env, render_mode=None if args.no_video else "rgb_array", **kwargs)
    dt = find_dt(env)
    if not args.no_video:
        env = RecordEpisodes(env, folder, args.fps, progress=True)
    controller = OptionController(args.model, dt=dt, vec_normalize=args.vec_normalize)
    trace = play(controller, env, args.seed)
    env.close()
    folder.mkdir(parents=True, exist_ok=True)
    plot(trace, args.env, folder / "episode.png")
    print(f"return {sum(trace.rewards):.1f}; wrote {', '.join(sorted(str(file) for file in folder.glob('episode*')))}")


if __name__ == "__main__":
    main()
