"""Prints the results of ``skinnode bench accuracy --only detection``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skinnode.bench.accuracy_detection import NOISE, REACHABLE
from skinnode.bench.detection_patch import FALSE_ALARMS_PER_HOUR


def print_all(figures: dict[str, Any], echo: Callable[[str], object]) -> None:
    """Print the tables."""
    _print_found(figures["found"], echo)
    echo("\ntaps found, staggered h=0.5, noise 1e-3, by duration in scans")
    for row in figures["taps"]:
        echo(f"  {row['kind']:14}{row['depth']:5.0%}{row['scans']:4} scans{row['found']:7.0%}")
    echo("\nslow presses, held presses and creep; staggered h=0.5, noise 1e-3 unless stated")
    for row in figures["slow"]:
        if row["what"] == "slow press":
            at = "not found" if row["found_at"] is None else f"found at {row['found_at']:.1%}"
            echo(f"  {row['depth']:.0%} of the layer height in {row['seconds']:g} s: {at}")
        elif row["what"] == "held press":
            kept = "touched throughout" if row["kept"] else "NOT touched throughout"
            end = f"released after {row['released_frames']} frames"
            echo(f"  {row['depth']:.0%} held for 10 min, {row['drift']} drift: {kept}, {end}")
        else:
            echo(
                f"  creep of 10 % of a 30 % press, time constant {row['constant_s']:g} s, noise "
                f"{row['noise']:.0e}: touched for {row['touched_s']:.1f} s, {row['new_onsets']} new onsets"
            )
    echo("\nthe detector's false alarms at rest")
    for row in figures["alarms"]:
        echo(
            f"  noise {row['noise']:.0e}, {row['drift']:6} drift: {row['alarms']:4} in {row['hours']:g} h,"
            f" {row['per_hour']:.2g} per hour, set to {row['set_per_hour']:g} ({row['cpu_s']:.0f} s CPU time)"
        )
    time = figures["time"]
    echo(
        f"\nCPU time per frame at rest, fastest of 31 rounds: {time['median_us']:.1f} µs (median), "
        f"{time['mean_us']:.1f} µs (mean); mean in the median round {time['median_of_rounds_us']:.1f} µs"
    )
    stream = ", ".join(f"{share:g} %: {each:.0f} µs" for share, each in time["stream_us"].items())
    echo(f"CPU time per frame in a stream with touches, percentiles: {stream}")
    echo("\nrequirements")
    for row in figures["must"]:
        verdict = "met" if row["reached"] else "NOT MET"
        echo(f"  {row['what']:62}{row['value']:>8.3g}  {row['limit']:18}{verdict}")


def _print_found(rows: list[dict[str, Any]], echo: Callable[[str], object]) -> None:
    echo(
        f"\npresses found within 1, 2, 3 and 4 frames; noise {NOISE:.0e}, {FALSE_ALARMS_PER_HOUR:g} false "
        "alarms per hour, all gains drift by 1 % per hour"
    )
    frames = "".join(f"{n:6}" for n in range(1, 5))
    echo(f"  {'layout':16}{'drift':8}{'load':14}{'depth':>6}{'signal':>8}{frames}{'release':>9}")
    for row in rows:
        shares = "".join(f"{share:6.0%}" for share in row["within"])
        release = "-" if row["released_median"] is None else f"{row['released_median']:.0f}"
        late = f"  {row['late']} not released" if row["late"] else ""
        beyond = "  beyond reach" if row["signal"] < REACHABLE else ""
        where = f"{row['layout']} h={row['height']:g}"
        load = f"{row['kind']:14}{row['depth']:6.0%}{row['signal']:8.1f}"
        echo(f"  {where:16}{row['drift']:8}{load}{shares}{release:>9}{late}{beyond}")
