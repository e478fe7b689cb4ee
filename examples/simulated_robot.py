"""A robot in a process of its own, with a clock of its own, that speaks JSON over UDP: two joints that go where they are told.

    python examples/simulated_robot.py --port 5005

It tells its state 100 times a second to whoever spoke to it last. Who commands it should be gentle, and should not go silent:
it holds its joints after 0.3 s without a command. When it is stopped it prints what it saw.
"""

import argparse
import json
import signal
import socket
import time

import numpy as np

PERIOD = 0.01
#: Joints follow their commands with this time constant, in s
LAG = 0.05
#: Without a command for this long it holds still, in s
WATCHDOG = 0.3


def clock() -> float:
    """The robot's time: it began elsewhere, and runs a little fast."""
    return 1234.5 + 1.0003 * time.monotonic()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=5005, help="0 for any that is free")
    parser.add_argument("--silent-every", type=float, default=0.0, help="say nothing for 0.6 s that often, in s; 0 for never")
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    port.bind(("127.0.0.1", args.port))
    port.setblocking(False)
    print(f"listening on {port.getsockname()[1]}", flush=True)

    positions, velocities, command = np.zeros(2), np.zeros(2), np.zeros(2)
    master = None
    commanded_at = began = clock()
    report = {"commands": 0, "largest_change": 0.0, "watchdog": 0}
    watching = False
    try:
        while True:
            now = clock()
            while True:
                try:
                    message, master = port.recvfrom(4096)
                except BlockingIOError:
                    break
                wanted = json.loads(message).get("positions")
                if wanted is None:
                    continue
                if watching:
                    report["largest_change"] = max(report["largest_change"], float(np.abs(np.array(wanted) - command).max()))
                command, commanded_at, watching = np.array(wanted, dtype=float), now, True
                report["commands"] += 1
            if watching and now - commanded_at > WATCHDOG:
                command, watching = positions.copy(), False
                report["watchdog"] += 1
            velocities = (command - positions) / LAG
            positions = positions + PERIOD * velocities
            silent = args.silent_every and (now - began) % args.silent_every > args.silent_every - 0.6
            if master is not None and not silent:
                state = {"time": now, "positions": positions.tolist(), "velocities": velocities.tolist()}
                port.sendto(json.dumps(state).encode(), master)
            time.sleep(PERIOD)
    except KeyboardInterrupt:
        print(json.dumps(report), flush=True)


if __name__ == "__main__":
    main()
