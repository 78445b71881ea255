"""How fast the simulated arm runs."""

from time import perf_counter

import numpy as np

import settings as bars
from results import Section, at_least
from settings import Settings

TEXT = """\
Seconds simulated per second on one core: the simulated rig (regulators at 1 kHz, tracker at 40 Hz,
default silicone with creep and hysteresis) under commands at 100 Hz that follow slow sines, read
after every command. Median of repetitions; compiled before. Full: with inertia, a step of 1 ms."""


def section(sizes: Settings) -> Section:
    """The table of the simulator."""
    out = Section("Simulated arm", TEXT, ("arm", "dynamics", "step", "times real time"))
    for name in ("stiff-flop-1", "stiff-flop-2-hanging", "stiff-flop-3"):
        for dynamics, step in (("full", 0.001), ("quasi-static", 0.001), ("quasi-static", 0.01)):
            speed = _speed(name, dynamics, step, sizes)
            out.rows.append((name, dynamics, f"{step * 1e3:g} ms", f"{speed:.3g}"))
            out.data[f"{name} {dynamics} {step}"] = speed
            if name == "stiff-flop-2-hanging" and dynamics == "full":
                bar = at_least(f"{name}, full dynamics", bars.TIMES_REAL_TIME, speed, "times")
                out.verdicts.append(bar)
    return out


def _speed(name: str, dynamics: str, step: float, sizes: Settings) -> float:
    from stiffopt.model.robot_files import load_description
    from stiffopt.rig.assembly import make_rig
    from stiffopt.rig.config import RigDescription

    description = RigDescription(
        robot=name,
        supply={"driver": "simulated"},
        tracker={"driver": "simulated"},
        plant={"dynamics": dynamics, "seed": sizes.seed, "discretisation": {"step": step}},
    )
    duration = 2.0 if sizes.quick else 10.0
    speeds = []
    with make_rig(description, load_description(name)) as rig:
        rig.supply.arm()
        phases = np.linspace(0, 2, rig.supply.n)
        for _ in range(min(5, sizes.repetitions)):
            begin = perf_counter()
            for tick in range(round(duration * 100)):
                rig.command(4e4 * (1 + np.sin(0.01 * tick * 2 + phases)))
                rig.clock.sleep(0.01)
                rig.observe()
            speeds.append(duration / (perf_counter() - begin))
    return float(np.median(speeds))
