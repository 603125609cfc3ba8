"""``skinnode eds``: generates a patch's EDS or DCF for another CANopen master, and C99 code for firmware."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._layout_option import HELP as LAYOUT_HELP

if TYPE_CHECKING:
    from skinnode.model.layout import PatchLayout
    from skinnode.protocol.profile import PatchProfile

_DEFAULT_SIZES = {
    "--upper-wires": 10,
    "--lower-wires": 30,
    "--upper-electrodes": 10,
    "--lower-electrodes": 10,
}


def eds(
    upper_wires: Annotated[
        int | None,
        typer.Option(min=1, max=254, help="Number of upper wires, U; default 10."),
    ] = None,
    upper_electrodes: Annotated[
        int | None, typer.Option(min=1, max=255, help="Number of electrodes per upper wire, N; default 10.")
    ] = None,
    lower_wires: Annotated[
        int | None,
        typer.Option(min=1, max=254, help="Number of lower wires, K; default 30."),
    ] = None,
    lower_electrodes: Annotated[
        int | None, typer.Option(min=1, max=255, help="Number of electrodes per lower wire, M; default 10.")
    ] = None,
    layout: Annotated[
        str | None, typer.Option(help=f"Use the sizes of a layout: {LAYOUT_HELP}", metavar="LAYOUT")
    ] = None,
    code_bits: Annotated[
        int, typer.Option(help="Width of a resistance code in bits: 16 or 24.", metavar="16|24")
    ] = 16,
    fd: Annotated[bool, typer.Option("--fd", help="Send PDOs in CAN FD frames.")] = False,
    dcf: Annotated[bool, typer.Option("--dcf", help="Print the DCF of one node; needs --node-id.")] = False,
    node_id: Annotated[
        int | None, typer.Option(min=1, max=127, help="Node-ID of the DCF.", metavar="N")
    ] = None,
    bitrate: Annotated[
        int | None, typer.Option(help="Bits per second in the DCF; default 1000000.", metavar="BPS")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write to this file instead of stdout.", metavar="FILE"),
    ] = None,
    c: Annotated[
        Path | None,
        typer.Option(
            "--c",
            help="Write the C99 kit of the patch, for a board or another master, into this folder.",
            metavar="FOLDER",
        ),
    ] = None,
) -> None:
    """Print the EDS or the DCF of a patch (CiA 306), or write its C99 kit.

    The EDS of a patch depends only on the wire and electrode counts, the code width and --fd. The EDS files
    of the reference patches are in eds/. With --layout, the C99 kit also contains the electrode coordinates.
    """
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import require_writable, write_text
    from skinnode.protocol.c_kit import kit_files
    from skinnode.protocol.eds_files import dcf_text, eds_text

    sizes = {
        "--upper-wires": upper_wires,
        "--lower-wires": lower_wires,
        "--upper-electrodes": upper_electrodes,
        "--lower-electrodes": lower_electrodes,
    }
    profile, electrodes = _patch(
        {name: size for name, size in sizes.items() if size is not None}, layout, code_bits, fd
    )
    if dcf and node_id is None:
        raise ConfigError("--node-id", None, "a node-ID from 1 to 127 for the DCF")
    for option, value in (("--node-id", node_id), ("--bitrate", bitrate)):
        if value is not None and not dcf:
            raise ConfigError(
                option, value, "only with --dcf, because an EDS does not describe a particular node"
            )
    if c is not None:
        _refuse_with_kit({"--dcf": dcf or None, "--output": output and str(output)})
        _write_kit(c, kit_files(profile, electrodes))
        return
    if output is not None:
        require_writable("--output", output)
    bitrate_bps = 1_000_000 if bitrate is None else bitrate
    text = eds_text(profile) if node_id is None else dcf_text(profile, node_id, bitrate_bps)
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_text("--output", output, text)


def _refuse_with_kit(others: dict[str, object]) -> None:
    """Refuse options that have no effect with --c; ``others`` contains their values, or None if not given."""
    from skinnode.errors import ConfigError

    for option, value in others.items():
        if value is not None:
            raise ConfigError(option, value, "not together with --c")


def _write_kit(folder: Path, texts: dict[str, str]) -> None:
    """Write the files of the C99 kit, and print their names and folder."""
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import write_text
    from skinnode.protocol.c_kit import may_replace

    files = {folder / name: text for name, text in texts.items()}
    try:
        folder.mkdir(exist_ok=True)
        foreign = next((file for file in files if not may_replace(file)), None)
    except OSError as error:
        raise ConfigError("--c", str(folder), f"a writable folder ({error.strerror})") from error
    if foreign is not None:
        raise ConfigError("--c", str(foreign), "no such file, or a file written by skinnode eds --c")
    for file, text in files.items():
        write_text("--c", file, text)
    typer.echo(f"wrote {', '.join(file.name for file in files)} to {folder}")


def _patch(
    sizes: dict[str, int], layout: str | None, code_bits: int, fd: bool
) -> tuple[PatchProfile, PatchLayout | None]:
    """Return the profile of the patch, and its layout if one is given."""
    from skinnode.cli._layout_option import find_layout, import_from_here
    from skinnode.errors import ConfigError
    from skinnode.protocol.profile import PatchProfile

    if layout is None:
        rows, columns, upper, lower = (_DEFAULT_SIZES | sizes).values()
        return PatchProfile(rows, columns, upper, lower, code_bits, bus="fd" if fd else "classic"), None
    if sizes:
        raise ConfigError(next(iter(sizes)), next(iter(sizes.values())), "only without --layout")
    import_from_here()
    electrodes = find_layout(layout)
    return PatchProfile.from_layout(electrodes, code_bits, "fd" if fd else "classic"), electrodes
