"""Run an exported policy in a control loop, without PyTorch.

The file comes from a trained model:

    from sb3_ctco.export import export_onnx
    export_onnx(model, "pendulum.onnx")

and runs anywhere that has numpy, gymnasium and onnxruntime:

    python examples/run_exported.py pendulum.onnx --env Pendulum-v1
    python examples/run_exported.py ball.onnx --env sb3_ctco/ball_in_cup-catch-v0 --rate 250 --set-rate
"""

import argparse
import sys
import time

import gymnasium as gym

from sb3_ctco import OptionController


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="an .onnx file")
    parser.add_argument("--env", required=True, help="Gymnasium id of the bare environment")
    parser.add_argument("--rate", type=float, help="control rate in Hz; by default the one of training")
    parser.add_argument("--set-rate", action="store_true", help="make the environment with dt=1/rate, if it takes dt")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--real-time", action="store_true", help="pace the loop by the wall clock, as a robot does")
    args = parser.parse_args()

    controller = OptionController(args.policy, dt=1 / args.rate if args.rate else None)
    env = gym.make(args.env, **({"dt": controller.dt} if args.set_rate else {}))
    for episode in range(args.episodes):
        obs, _ = env.reset(seed=episode)
        controller.reset()
        episode_return, decisions, ticks, done = 0.0, 0, 0, False
        start = time.perf_counter()
        while not done:
            action = controller(obs)
            decisions += controller.elapsed == 0
            obs, reward, terminated, truncated, _ = env.step(action)
            episode_return += float(reward)
            ticks += 1
            done = terminated or truncated
            if args.real_time:
                time.sleep(max(0.0, start + ticks * controller.dt - time.perf_counter()))
        rate = decisions / (ticks * controller.dt)
        print(f"episode {episode}: return {episode_return:.1f}, {ticks} ticks, {rate:.1f} decisions a second")
    env.close()
    print(f"PyTorch was {'' if 'torch' in sys.modules else 'not '}loaded")


if __name__ == "__main__":
    main()
