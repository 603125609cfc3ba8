"""``skinnode hand``: checks or creates a hand file, prints its JSON Schema, or writes ROS 2 packages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skinnode.cli._help import App
from skinnode.text.words import counted

if TYPE_CHECKING:
    from rich.table import Table

    from skinnode.bus_load.plan import BusPlan
    from skinnode.config import HandConfig
    from skinnode.host.limitations import Limitation
    from skinnode.host.solve_rate import SolveRate

app = App(
    help="Check or create a hand file, compute its bus load, print the JSON Schema, or write ROS 2 packages.",
    no_args_is_help=True,
)


@app.command()
def check(
    hand: Annotated[Path, typer.Argument(help="The hand to check.", metavar="HAND.toml")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Validate a hand file and the files named in it, compute the bus load, and list the hand's limitations.

    For each bus, the command prints two planned loads: the worst case, in which every frame has its maximum
    length, and the typical case, for random data. For each patch, it prints the worst-case time from SYNC to
    the end of the summary. For each frame in `others`, it prints the longest wait for the bus. The command
    also measures how many scans per second this computer can solve at the hand's noise while all patches are
    touched. Notes list results that the hand cannot provide, such as shear. No bus is opened. The exit status
    is 1 if the load of a bus exceeds its max_load, 2 if the file cannot be used.
    """
    from skinnode.bus_load.plan import plan_of, require_room
    from skinnode.config import load_hand
    from skinnode.errors import BusLoadError, ConfigError
    from skinnode.host.hand_files import check_files
    from skinnode.host.limitations import limitations
    from skinnode.host.solve_rate import solve_rate
    from skinnode.transport.port import allowed_interfaces, is_interface

    config = load_hand(hand)
    for number, bus in enumerate(config.buses):
        if not is_interface(bus):
            key = f"buses[{number}].interface"
            raise ConfigError(key, bus.interface, allowed_interfaces(bus), where=config.where(key))
    plans, refused = plan_of(config), []
    check_files(config)
    for plan in plans:
        try:
            require_room(config, plan)
        except BusLoadError as error:
            refused.append(str(error))
    rate = solve_rate(config)
    limits = limitations(config, rate)
    if as_json:
        report = {
            "hand": config.name,
            "buses": [_facts(plan) for plan in plans],
            "refused": refused,
            "solving": None
            if rate is None
            else {"threads": rate.threads, "scan_s": dict(rate.scan_s), "rate_hz": rate.rate_hz},
            "notes": [asdict(limit) for limit in limits],
        }
        typer.echo(json.dumps(report, indent=2))
    else:
        _print(config, plans)
        typer.echo(f"\n{_solving(config, rate)}")
        _print_notes(config, limits)
    for line in refused:
        typer.echo(f"error: {line}", err=True)
    if refused:
        raise typer.Exit(1)


def _facts(plan: BusPlan) -> dict[str, Any]:
    return {
        "bus": plan.bus.name,
        "role": plan.bus.role,
        "sync_period_s": plan.period_s,
        "frames_per_s": plan.frames_per_s,
        "load": plan.load,
        "typical_load": plan.typical_load,
        "max_load": plan.bus.max_load,
        "shortest_period_ms": plan.shortest_period_ms,
        "scans": [
            {
                "patch": scan.patch,
                "node_id": scan.node_id,
                "chunks": scan.chunks,
                "paced_s": scan.paced_s,
                "sync_to_summary_s": scan.worst_s,
            }
            for scan in plan.scans
        ],
        "frames": [
            {
                "name": frame.name,
                "can_id": frame.can_id,
                "length": frame.length,
                "frames_per_s": frame.frames_per_s,
                "load": frame.load,
                "typical_load": frame.typical_load,
                "worst_response_s": frame.response_s,
            }
            for frame in plan.frames
        ],
    }


def _print(config: HandConfig, plans: tuple[BusPlan, ...]) -> None:
    from skinnode.cli._console import console

    out = console(soft_wrap=True)
    where = counted(len(plans), "bus", "buses")
    patches = counted(len(config.patches), "patch", "patches")
    out.print(f"{config.name}: {patches} on {where}, a scan every {config.sync.period_ms} ms")
    for plan in plans:
        out.print()
        out.print(_headline(plan))
        out.print(_scan_table(plan))
        out.print(_frame_table(plan))
        if plan.others:
            out.print(_other_table(plan))
        for line in _remarks(plan):
            out.print(line)


def _solving(config: HandConfig, rate: SolveRate | None) -> str:
    """Return a line about the scans that this computer can solve."""
    if rate is None:
        return "solving: not measured, because no kernels have been compiled yet; skinnode demo compiles them"
    slowest = max(rate.scan_s, key=lambda name: rate.scan_s[name])
    return (
        f"solving: {1e3 * rate.scan_s[slowest]:.1f} ms of CPU time per scan of {slowest} as a touch moves; "
        f"{rate.rate_hz:.3g} scans/s of each patch with {counted(rate.threads, 'thread')} if all patches are "
        f"touched ({1e3 / config.sync.period_ms:.3g} planned)"
    )


def _print_notes(config: HandConfig, limits: Sequence[Limitation]) -> None:
    if limits:
        typer.echo()
    for limit in limits:
        every = len(limit.patches) == len(config.patches) > 1
        whose = "all patches" if every else ", ".join(limit.patches)
        typer.echo(f"note: {whose}: {limit.text} ({limit.key})")


def _headline(plan: BusPlan) -> str:
    bus = plan.bus
    rate = f"{bus.bitrate_bps / 1e6:g} Mbit/s" + (f" / {bus.data_bitrate_bps / 1e6:g}" if bus.fd else "")
    return (
        f"{bus.name} ({bus.interface} {bus.channel}, {rate}, {bus.role}): {plan.frames_per_s:.0f} frames/s, "
        f"load {plan.load:.1%} at worst, {plan.typical_load:.1%} typical, of {bus.max_load:.0%} allowed"
    )


def _table(*columns: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
    return table


def _scan_table(plan: BusPlan) -> Table:
    table = _table("patch", "node", "chunks", "paced ms", "SYNC to summary ms", "of the period")
    for scan in plan.scans:
        worst = (
            ("no bound", "")
            if scan.worst_s is None
            else (f"{scan.worst_s * 1e3:.1f}", f"{scan.worst_s / plan.period_s:.0%}")
        )
        table.add_row(scan.patch, str(scan.node_id), str(scan.chunks), f"{scan.paced_s * 1e3:.1f}", *worst)
    return table


def _frame_table(plan: BusPlan) -> Table:
    """Return a table of bus load with one row per kind of frame, summed over all patches."""
    kinds: dict[str, list[float]] = {}
    for frame in plan.frames:
        sums = kinds.setdefault(frame.name.partition(" of ")[0], [0.0, 0.0, 0.0])
        for i, value in enumerate((frame.frames_per_s, frame.load, frame.typical_load)):
            sums[i] += value
    table = _table("frames", "per second", "load at worst", "typical")
    for kind, (rate, load, typical) in kinds.items():
        table.add_row(kind, f"{rate:.1f}", f"{load:.2%}", f"{typical:.2%}")
    return table


def _other_table(plan: BusPlan) -> Table:
    """Return a table of the longest time that each frame of another device waits for the bus."""
    table = _table("others", "bytes", "every ms", "queued to sent ms")
    for frame in plan.others:
        worst = "no bound" if frame.response_s is None else f"{frame.response_s * 1e3:.2f}"
        table.add_row(f"0x{frame.can_id:03X}", str(frame.length), f"{frame.period_s * 1e3:g}", worst)
    return table


def _remarks(plan: BusPlan) -> list[str]:
    late = [s.patch for s in plan.scans if s.worst_s is None or s.worst_s > plan.period_s]
    if not late:
        return []
    return [f"note: in the worst case, a scan of {', '.join(late)} does not end before the next SYNC"]


@app.command()
def schema() -> None:
    """Print the JSON Schema of a hand file, for editors that complete and check TOML.

    A hand file names its schema in the first line, `#:schema PATH`; this version's schema is
    skinnode/config/hand.schema.json.
    """
    from skinnode.config.schema import schema_text

    typer.echo(schema_text(), nl=False)


@app.command()
def ros2(
    hand: Annotated[Path, typer.Argument(help="The hand.", metavar="HAND.toml")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Existing folder, normally src of a workspace.", metavar="FOLDER"
        ),
    ],
) -> None:
    """Write two ROS 2 packages: the buses of a hand for ros2_canopen, and the messages skinnode_msgs.

    The first package contains a bus.yml, the EDS files and a launch file for each bus. An existing file with
    different content is not overwritten. No bus is opened.
    """
    from skinnode.config import load_hand
    from skinnode.messages import message_package, ros2_canopen

    config = load_hand(hand)
    packages = {
        ros2_canopen.package_name(config): ros2_canopen.package_files(config),
        message_package.PACKAGE: message_package.package_files(),
    }
    _write_new({output / path: text for files in packages.values() for path, text in files.items()}, output)
    for name, files in packages.items():
        typer.echo(f"wrote {output / name} ({counted(len(files), 'file')})")
    masters = [bus.name for bus in config.buses if bus.role == "master"]
    if masters:
        typer.echo(
            f'note: {", ".join(masters)}: the host must be a guest alongside ros2_canopen (role = "guest")'
        )


def _write_new(texts: dict[Path, str], folder: Path) -> None:
    """Write files into an existing folder, unless one of them already exists with different content."""
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import write_text

    if not folder.is_dir():
        raise ConfigError("--output", str(folder), "an existing folder")
    try:
        for file, text in texts.items():
            if file.exists() and file.read_bytes() != text.encode():
                raise ConfigError(
                    "--output", str(file), "a new file, or a file with the same content; remove it first"
                )
            file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("--output", str(folder), f"a writable folder ({error.strerror})") from error
    for file, text in texts.items():
        write_text("--output", file, text)


@app.command()
def new(
    patches: Annotated[int, typer.Option(min=1, max=127, help="Number of patches.", metavar="N")] = 4,
    buses: Annotated[
        int, typer.Option(min=1, max=16, help="Number of buses that share the patches.", metavar="N")
    ] = 1,
) -> None:
    """Print a commented hand file as a starting point. Its SYNC period is chosen to suit the bus load.

    The patches are divided evenly among the buses, in the order of their node-IDs.
    """
    from skinnode.bus_load.plan import plan_of
    from skinnode.config import parse_hand
    from skinnode.errors import ConfigError

    if buses > patches:
        raise ConfigError("--buses", buses, f"at most {patches}, one bus per patch (--patches)")
    bus_of = {i: f"can{(i - 1) * buses // patches}" for i in range(1, patches + 1)}
    plans = plan_of(parse_hand(_table_of(bus_of, period_ms=60_000)))
    shortest_ms = max(plan.shortest_period_ms or 60_000 for plan in plans)
    period_ms = max(10, -(-shortest_ms // 10) * 10)
    text = _NEW.format(
        buses="".join(_NEW_BUS.format(n=n, group=n + 2) for n in range(buses)),
        period_ms=period_ms,
        rate=f"{1e3 / period_ms:.3g}",
    )
    for i, name in bus_of.items():
        text += _NEW_PATCH.format(i=i, bus=f'bus = "{name}"\n' if buses > 1 else "")
    typer.echo(text, nl=False)


def _table_of(bus_of: dict[int, str], period_ms: int) -> dict[str, Any]:
    return {
        "buses": [{"name": name, "channel": name} for name in dict.fromkeys(bus_of.values())],
        "sync": {"period_ms": period_ms},
        "patches": [{"name": f"patch{i}", "node_id": i, "bus": name} for i, name in bus_of.items()],
    }


_NEW = """\
#:schema hand.schema.json
# Hand file. Check it:  skinnode hand check hand.toml
# Simulate it:          vcan-sim hand.toml, and in another terminal: skinnode host hand.toml
# For completion and checks in an editor:  skinnode hand schema > hand.schema.json

name = "hand"
{buses}
[sync]
period_ms = {period_ms}                    # each SYNC starts one scan of every patch: {rate} per second

[solver]
method = "auto"                   # every field has contacts with forces: field.contacts, HandFrame.contacts
# max_std_m = 20e-6               # field.precise: maximum standard deviation of a displacement, in metres,
# max_force_std_n = 0.1           # and of a contact's normal force; default: limits a healthy patch meets

[stream]
partial = "pass"                  # incomplete scans: pass them on with a mask, or "withhold"
"""
_NEW_BUS = """
[[buses]]
name = "can{n}"
interface = "udp_multicast"       # socketcan, pcan, kvaser or another python-can interface
channel = "239.74.163.{group}"          # for socketcan: "can{n}"
bitrate_bps = 1_000_000
role = "master"                   # "guest" if the robot has its own CANopen master
max_load = 0.7                    # maximum planned load of this bus, as a fraction
"""
_NEW_PATCH = """
[[patches]]
name = "patch{i}"
{bus}node_id = {i}
# serial = 12345                  # expected number; LSS uses it to find a node that has no node-ID
# link = "palm_link"              # name of the robot link that carries the patch; default: the hand itself
# pose = {{ position_m = [0.0, 0.0, 0.0], rpy_rad = [0.0, 0.0, 0.0] }}   # in the frame of the link
layout = {{ preset = "staggered", pitch_m = 4e-3, height_m = 2e-3, upper_wires = 10, upper_electrodes = 10 }}
# calibration = {{ young_pa = 1e6, force_calibrated = true }}   # after a test with known forces
tolerances = "ordinary"           # manufacturing tolerances; "exact" for a simulated patch
"""
