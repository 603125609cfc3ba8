"""``skinnode eds``: the electronic data sheet of a patch of any size, for another CANopen master."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def eds(
    upper_wires: Annotated[
        int, typer.Option(min=1, max=254, help="Upper wires U, the rows of a frame.")
    ] = 10,
    upper_electrodes: Annotated[
        int, typer.Option(min=1, max=255, help="Electrodes of an upper wire N.")
    ] = 10,
    lower_wires: Annotated[int, typer.Option(min=1, max=254, help="Lower wires K, the columns.")] = 30,
    lower_electrodes: Annotated[int, typer.Option(min=1, max=255, help="Electrodes of a lower wire M.")] = 10,
    code_bits: Annotated[int, typer.Option(help="Width of a code: 16 or 24.", metavar="16|24")] = 16,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write to this file instead.", metavar="FILE")
    ] = None,
) -> None:
    """Print the EDS of a patch.

    It depends on nothing but the sizes and the code width. The files of the reference patches are in eds/.
    """
    from skinnode.wire.profile import PatchProfile, eds_text

    text = eds_text(PatchProfile(upper_wires, lower_wires, upper_electrodes, lower_electrodes, code_bits))
    if output is None:
        typer.echo(text, nl=False)
    else:
        output.write_text(text, encoding="ascii", newline="\n")
