"""``skinnode eds``: prints the electronic data sheet of a patch of any size, for another CANopen master."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._layout_option import HELP as LAYOUT_HELP

if TYPE_CHECKING:
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
        str | None, typer.Option(help=f"Take the sizes from a layout: {LAYOUT_HELP}", metavar="LAYOUT")
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
) -> None:
    """Print the EDS or the DCF of a patch (CiA 306).

    The EDS of a patch depends only on the wire and electrode counts, the code width and --fd. The EDS files
    of the reference patches are in eds/.
    """
    from skinnode.errors import ConfigError
    from skinnode.files.output_file import require_writable, write_text
    from skinnode.protocol.eds_files import dcf_text, eds_text

    sizes = {
        "--upper-wires": upper_wires,
        "--lower-wires": lower_wires,
        "--upper-electrodes": upper_electrodes,
        "--lower-electrodes": lower_electrodes,
    }
    profile = _profile(
        {name: size for name, size in sizes.items() if size is not None}, layout, code_bits, fd
    )
    if dcf and node_id is None:
        raise ConfigError("--node-id", None, "a node-ID from 1 to 127 for the DCF")
    for option, value in (("--node-id", node_id), ("--bitrate", bitrate)):
        if value is not None and not dcf:
            raise ConfigError(
                option, value, "only with --dcf, because an EDS does not describe a particular node"
            )
    if output is not None:
        require_writable("--output", output)
    bitrate_bps = 1_000_000 if bitrate is None else bitrate
    text = eds_text(profile) if node_id is None else dcf_text(profile, node_id, bitrate_bps)
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_text("--output", output, text)


def _profile(sizes: dict[str, int], layout: str | None, code_bits: int, fd: bool) -> PatchProfile:
    from skinnode.cli._layout_option import find_layout, import_from_here
    from skinnode.errors import ConfigError
    from skinnode.protocol.profile import PatchProfile

    if layout is None:
        rows, columns, upper, lower = (_DEFAULT_SIZES | sizes).values()
        return PatchProfile(rows, columns, upper, lower, code_bits, bus="fd" if fd else "classic")
    if sizes:
        raise ConfigError(next(iter(sizes)), next(iter(sizes.values())), "only without --layout")
    import_from_here()
    return PatchProfile.from_layout(find_layout(layout), code_bits, "fd" if fd else "classic")
