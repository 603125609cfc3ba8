"""Provides the electronic data sheet (EDS) of a node: generated for a patch, otherwise read from a file.

The EDS is parsed with the conformance suite's reader, which preserves default values as written. The canopen
library does not; the host uses that library as a second, independent reader of a patch's EDS.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from skinnode.canopen import indices as od
from skinnode.conformance.eds_reader import Eds, parse_eds, parse_eds_file
from skinnode.errors import ConfigError, NodeError, ProfileError, Shown
from skinnode.host.sdo_client import RemoteOd
from skinnode.protocol.eds_files import eds_name, eds_text
from skinnode.protocol.profile import BusType, PatchProfile


class DataSheet(NamedTuple):
    """EDS or DCF, both parsed and as text."""

    eds: Eds
    text: str
    """Content of the file; see :class:`~skinnode.canopen.eds_encoding.EdsText`."""
    codec: str = "utf-8"
    """Encoding of the non-ASCII characters in the text."""
    note: str = ""
    """Message about the assumed encoding; empty for an ASCII file."""


def read_profile(remote: RemoteOd) -> PatchProfile | None:
    """Read the profile of a patch from its descriptor (0x2000); None if the device is not a patch.

    Raises NodeError if the device does not answer or the descriptor is invalid.
    """
    try:
        identity = [remote.read(od.IDENTITY, sub, "u32") for sub in (od.IDENTITY_VENDOR, od.IDENTITY_PRODUCT)]
        if identity != [od.VENDOR_ID, od.PRODUCT_CODE]:
            return None
        subs = od.ROWS, od.COLUMNS, od.UPPER_ELECTRODES, od.LOWER_ELECTRODES, od.CODE_BITS, od.PDO_BYTES
        rows, columns, upper, lower, bits, pdo_bytes = (remote.read(od.DESCRIPTOR, sub, "u8") for sub in subs)
        checked = remote.read(od.IDENTITY, od.IDENTITY_REVISION, "u32") > od.UNCHECKED_REVISION_NUMBER
        bus: BusType = "classic" if pdo_bytes == 8 else "fd"
        return PatchProfile(rows, columns, upper, lower, bits, bus=bus, checked=checked)
    except ConfigError as error:
        raise NodeError(
            remote.node_id, f"its descriptor (0x2000) does not describe a patch: {error}"
        ) from None


def load_data_sheet(path: Path) -> DataSheet:
    """Read an EDS or DCF.

    Raises:
        ConfigError: The file cannot be read.
        ProfileError: The file is neither an EDS nor a DCF.
    """
    eds, read = parse_eds_file(path)
    return DataSheet(eds, read.text, read.codec, f"{path} {read.note}" if read.note else "")


def data_sheet_of(remote: RemoteOd, path: Path | None) -> DataSheet:
    """Return the EDS of a node.

    Args:
        remote: The node.
        path: EDS file of the node; not needed for a patch.

    Raises:
        ProfileError: The node is not a patch, and no file is given.
    """
    if path is not None:
        return load_data_sheet(path)
    profile = read_profile(remote)
    if profile is None:
        allowed = f"the EDS of node {remote.node_id}, which is not a skinnode patch"
        raise ProfileError("--eds", Shown("no file"), allowed)
    text = eds_text(profile)
    return DataSheet(parse_eds(text, eds_name(profile)), text)
