"""Many simulated skins through two Zenoh routers: `make fleet`; docs/fleet.md has what came out.

Robots, each a process with a Zenoh session of its own, hand frames to the publication that `tactomo
zenoh` uses, 20 a second for each skin; a reader behind the second router counts what comes, what
its counts say was lost, and how old each touch is. Simulated are the skins, the daemons and their
ZeroMQ; the network is this computer's loopback; routers, sessions and publication are real.

    robots (client) ──> router 1 ──> router 2 ──> reader (client)
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import msgpack  # type: ignore[import-untyped]
import zenoh
from tactomo.stream import zenoh_bridge
from tactomo_client import Contact
from tactomo_client.messages import clock_id, encode_message

FRAMES_HZ = 20
SLICES = 10
"""Skins are not in step: a tenth of them has its frame in each tenth of a period."""
SETTLE_S = 5.0
DOWN_S = 3.0
END_S = 2.0
"""For what is still on its way."""


@dataclass(frozen=True)
class Case:
    """What is measured: how many skins and robots, and what happens to them."""

    skins: int
    touched: int = 0
    seconds: float = 15.0
    robots: int = 4
    heartbeat_s: float = zenoh_bridge.HEARTBEAT_S
    kills_router: bool = False
    knows_both: bool = False
    """Whether robots may connect to the second router, too."""


def session(mode: str, listen: int, *connect: int) -> zenoh.Session:
    """A Zenoh session on this computer alone, by ports."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, ports in (("listen", (listen,)), ("connect", connect)):
        ends = [f"tcp/127.0.0.1:{port}" for port in ports if port]
        config.insert_json5(f"{name}/endpoints", json.dumps(ends))
    # A session whose router is gone tries again after 0.1, 0.2, 0.4, ... s, at most 1 s.
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    config.insert_json5("connect/retry", json.dumps(retry))
    config.insert_json5("connect/timeout_ms", "-1")
    return zenoh.open(config)


def frame(name: str, sequence: int, contacts: list[Contact]) -> bytes:
    """One `contacts` message, as a daemon encodes one."""
    now_ns = time.monotonic_ns()
    header = {
        **{"session": "0" * 32, "sequence": sequence, "acquired_realtime_ns": time.time_ns()},
        **{"acquired_monotonic_ns": now_ns, "delay_ns": 1_200_000, "dated_by": "device"},
        **{"clock_id": clock_id(), "device_us": now_ns // 1000, "skew_ms": 0.0, "age_ns": 0},
        **{"tier": "fit" if contacts else "quiet", "tier_reason": "simulated", "flags": []},
        **{"misfit": 1.0, "confidence": None, "scan_counter": sequence},
    }
    return encode_message(name, "contacts", header | {"contacts": [asdict(c) for c in contacts]})


def touch() -> list[Contact]:
    """One contact with a new noise."""
    x, y, kpa = random.gauss(10, 0.1), random.gauss(-5, 0.1), random.gauss(170, 2)
    return [Contact(1, x, y, 706.9, 0.21, 0.01, kpa, force_n=0.12, peak_kpa=kpa, max_kpa=180.0)]


def robot(ports: list[int], number: int, case: Case, start_s: float) -> None:
    """Publish a robot's skins, print how many messages were sent, and stay until killed."""
    zenoh_bridge.HEARTBEAT_S = case.heartbeat_s  # type: ignore[misc]
    with session("client", 0, *ports) as own:
        publication = zenoh_bridge.Publication(own, f"robot{number}")
        names = [f"skin{n}" for n in range(case.skins // case.robots)]
        is_touched = {name: n < case.touched // case.robots for n, name in enumerate(names)}
        at_rest = {name: frame(name, 1, []) for name in names}
        wait_till(start_s)
        steps = round(case.seconds * FRAMES_HZ * SLICES)
        for step in range(steps):
            wait_till(start_s + step / (FRAMES_HZ * SLICES))
            for name in names[step % SLICES :: SLICES]:
                data = frame(name, step, touch()) if is_touched[name] else at_rest[name]
                publication.take("simulated", data)
        behind_s = time.monotonic() - start_s - case.seconds
        time.sleep(END_S)
        sent = sum(skin._counts["contacts"] for skin in publication._skins.values())
        said = {"sent": sent, "frames": steps // SLICES * len(names), "behind_s": behind_s}
        print(json.dumps(said), flush=True)
        signal.pause()  # its going away is not counted


def reader(port: int) -> None:
    """Count what comes until its input ends, and print it."""
    counts: dict[str, int] = {}
    said = {"received": 0, "bytes": 0, "lost": 0, "before_the_first": 0}
    latencies_ms: list[float] = []
    touched_at: list[float] = []

    def take(sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        key, body = str(sample.key_expr), sample.payload.to_bytes()
        assert sample.attachment
        count = int(sample.attachment.to_string())
        said["received"] += 1
        said["bytes"] += len(key) + len(body) + len(sample.attachment)
        said["lost" if key in counts else "before_the_first"] += count - counts.get(key, 0) - 1
        counts[key] = count
        fields = msgpack.unpackb(body)
        if fields["contacts"]:
            latencies_ms.append((now_ns - fields["acquired_monotonic_ns"]) / 1e6)
            touched_at.append(now_ns / 1e9)

    with session("client", 0, port) as own:
        tokens = Counter[str]()
        presence = own.liveliness().declare_subscriber(
            "tactomo/*/*", lambda s: tokens.update([str(s.kind)]), history=True
        )
        subscriber = own.declare_subscriber("tactomo/*/*/contacts", take)
        sys.stdin.read()
        subscriber.undeclare()  # type: ignore[no-untyped-call]
        presence.undeclare()  # type: ignore[no-untyped-call]
    latencies_ms.sort()
    gaps = [later - sooner for sooner, later in itertools.pairwise(touched_at)]
    figures = {
        **said,
        "skins": len(counts),
        "tokens": dict(tokens),
        "latency_ms": {q: at(latencies_ms, q) for q in (0.5, 0.99, 1.0)},
        "longest_gap_s": max(gaps, default=0.0),
    }
    print(json.dumps(figures))


def at(ordered: list[float], share: float) -> float | None:
    """A quantile of sorted values."""
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


def wait_till(time_s: float) -> None:
    """Sleep until a time on the monotonic clock."""
    time.sleep(max(0.0, time_s - time.monotonic()))


def measure(case: Case) -> dict[str, Any]:
    """Run a case and return its figures; processor seconds are those while skins publish."""
    ports = [free_port(), free_port()]
    with programs() as start:
        routers = [start("router", ports[0], 0), start("router", ports[1], ports[0])]
        start_s = time.monotonic() + SETTLE_S
        reading = start("reader", ports[1])
        doors = json.dumps(ports if case.knows_both else ports[:1])
        shared = (json.dumps(asdict(case)), start_s)
        robots = [start("robot", doors, n, *shared) for n in range(case.robots)]
        wait_till(start_s)
        everybody = {"router_1": routers[0], "router_2": routers[1], "reader": reading}
        everybody |= {f"robot_{n}": process for n, process in enumerate(robots)}
        before = {name: cpu_s(process) for name, process in everybody.items()}
        if case.kills_router:
            wait_till(start_s + case.seconds / 3)
            routers[0].send_signal(signal.SIGKILL)
            routers[0].wait()
            wait_till(start_s + case.seconds / 3 + DOWN_S)
            routers[0] = everybody["router_1"] = start("router", ports[0], 0)
            before["router_1"] = 0.0
        wait_till(start_s + case.seconds)
        used = {name: cpu_s(process) - before[name] for name, process in everybody.items()}
        said = [json.loads(process.stdout.readline()) for process in robots]
        figures: dict[str, Any] = json.loads(reading.communicate()[0])  # which ends its input
    sent = sum(each["sent"] for each in said)
    return {
        "case": asdict(case),
        "frames": sum(each["frames"] for each in said),
        "sent": sent,
        **figures,
        # A loss at the very end has no later message that tells it.
        "untold": sent - figures["received"] - figures["lost"] - figures["before_the_first"],
        "behind_s": max(each["behind_s"] for each in said),
        "bytes_s_per_skin": figures["bytes"] / case.seconds / case.skins,
        "cpu_s": used,
        "load": os.getloadavg()[0],
    }


@contextmanager
def programs() -> Iterator[Any]:
    """Start roles of this file as processes; all are ended in the end."""
    started: list[subprocess.Popen[str]] = []

    def start(*words: object) -> subprocess.Popen[str]:
        command = [sys.executable, __file__, *map(str, words)]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        started.append(subprocess.Popen(command, **pipes, text=True))
        return started[-1]

    yield start
    for process in started:
        with process:  # closes its pipes
            process.kill()


def cpu_s(process: subprocess.Popen[str]) -> float:
    """Processor time of a process, seconds."""
    with open(f"/proc/{process.pid}/stat") as file:
        user, system = file.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port


def router(port: int, other: int) -> None:
    """Be a router until killed."""
    with session("router", port, other):
        signal.pause()


def main() -> None:
    """Measure the cases that docs/fleet.md tells, and print each as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--skins", type=int, default=1000)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=15.0)
    asked = parser.parse_args()
    few = max(asked.robots, asked.skins // 10)
    seconds, robots = asked.seconds, asked.robots
    for name, case in {
        "at rest, by the clock (a tenth of the skins)": Case(few, 0, seconds, robots, 0.0),
        "at rest, by heartbeat": Case(asked.skins, 0, seconds, robots),
        "a tenth touched": Case(asked.skins, few, seconds, robots),
        "a router killed and back": Case(asked.skins, few, 2 * seconds, robots, kills_router=True),
        "likewise, robots know both": Case(
            asked.skins, few, 2 * seconds, robots, kills_router=True, knows_both=True
        ),
    }.items():
        print(json.dumps({name: measure(case)}), flush=True)


if __name__ == "__main__":
    zenoh.init_log_from_env_or("error")
    role, *words = sys.argv[1:] or ["main"]
    if role == "router":
        router(int(words[0]), int(words[1]))
    elif role == "reader":
        reader(int(words[0]))
    elif role == "robot":
        robot(json.loads(words[0]), int(words[1]), Case(**json.loads(words[2])), float(words[3]))
    else:
        main()
