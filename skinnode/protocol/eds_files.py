"""EDS and DCF files (CiA 306) for patches, including the reference files in ``eds/``."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.eds import Commissioning, DeviceInfo, render_eds
from skinnode.errors import ConfigError
from skinnode.protocol.profile import PatchProfile


def eds_name(profile: PatchProfile) -> str:
    """Return the file name of a patch's EDS."""
    variant = "-fd" if profile.bus == "fd" else ""
    return f"skinnode-{profile.rows}x{profile.columns}-u{profile.code_bits}{variant}.eds"


def eds_text(profile: PatchProfile) -> str:
    """Return the contents of a patch's EDS, which depends only on the profile."""
    return render_eds(device_info(profile, eds_name(profile)), profile.objects())


def dcf_text(profile: PatchProfile, node_id: int, bitrate_bps: int) -> str:
    """Return the contents of a patch's DCF, which depends only on the arguments.

    Args:
        profile: Dimensions of the patch.
        node_id: 1 to 127.
        bitrate_bps: Bit rate of the bus, in bit/s.

    Raises:
        ConfigError: If the node-ID is not in the range 1 to 127, or the bit rate is not supported.
    """
    if not 1 <= node_id <= od.MAX_NODE_ID:
        raise ConfigError("node_id", node_id, "1 to 127")
    if bitrate_bps not in od.BIT_RATES_BPS:
        raise ConfigError("bitrate_bps", bitrate_bps, f"one of {', '.join(map(str, od.BIT_RATES_BPS))}")
    name = eds_name(profile)
    file_name = f"{name.removesuffix('.eds')}-node{node_id}.dcf"
    device = Commissioning(node_id, bitrate_bps // 1000, f"patch {node_id}", name)
    return render_eds(device_info(profile, file_name), profile.objects(), device)


def device_info(profile: PatchProfile, file_name: str) -> DeviceInfo:
    """Return the general information in a patch's EDS or DCF.

    Args:
        profile: Dimensions of the patch.
        file_name: Name of the EDS or DCF.
    """
    variant = ", PDO over CAN FD" if profile.bus == "fd" else ""
    return DeviceInfo(
        file_name=file_name,
        description=f"{profile.rows} x {profile.columns} wires, {profile.code_bits}-bit codes{variant}",
        vendor_name="skinnode",
        vendor_number=od.VENDOR_ID,
        product_name=od.DEVICE_NAME,
        product_number=od.PRODUCT_CODE,
        revision_number=profile.revision_number,
        bit_rates_bps=od.BIT_RATES_BPS,
        rpdos=profile.rpdos,
        tpdos=profile.tpdos,
    )


REFERENCE_PROFILES: Final = (
    PatchProfile(10, 30, 10, 10, 16),
    PatchProfile(10, 30, 10, 10, 24),
    PatchProfile(10, 30, 10, 10, 16, bus="fd"),
    PatchProfile(10, 30, 10, 10, 24, bus="fd"),
)
"""Profiles of the EDS files in ``eds/``: a 10 × 30 patch in each wire format."""


def write_reference_files(folder: Path) -> None:
    """Write the EDS file of every reference profile.

    Args:
        folder: Folder for the files, which must exist.
    """
    for profile in REFERENCE_PROFILES:
        (folder / eds_name(profile)).write_text(eds_text(profile), encoding="ascii", newline="\n")
