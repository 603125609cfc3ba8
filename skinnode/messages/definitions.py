"""Definitions, in ``ros2msg`` format, of the messages that rosbags does not include.

``can_msgs/Frame`` is defined by ros_canopen and ``ros2_socketcan_msgs/FdFrame`` by ros2_socketcan. The
``skinnode_msgs`` messages are defined by this project. Their ``VERSION`` constant increases with every
change; readers refuse newer versions.
"""

from __future__ import annotations

import re
from typing import Final

OURS: Final = "skinnode_msgs/"
"""Name prefix of this project's own messages."""

CAN_FRAME: Final = "can_msgs/msg/Frame"
FD_FRAME: Final = "ros2_socketcan_msgs/msg/FdFrame"
FIELD_INFO: Final = "skinnode_msgs/msg/FieldInfo"
DATA_FAULT: Final = "skinnode_msgs/msg/DataFault"
CONTACT: Final = "skinnode_msgs/msg/Contact"
CONTACTS: Final = "skinnode_msgs/msg/Contacts"
JOURNAL_LINE: Final = "skinnode_msgs/msg/JournalLine"
FIELD: Final = "skinnode_msgs/msg/Field"
HEALTH_REPORT: Final = "skinnode_msgs/msg/HealthReport"

DEFINITIONS: Final = {
    CAN_FRAME: """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
""",
    FD_FRAME: """\
std_msgs/Header header
uint32 id
bool is_extended
bool is_error
uint8 len
uint8[<=64] data
""",
    DATA_FAULT: """\
# Faulty readings of a patch, which were left out of the solution.
uint16 VERSION=1
string part          # crossing, upper wire, lower wire or patch
string kind
int32 upper          # number of the upper wire; -1 if the fault affects all upper wires
int32 lower          # number of the lower wire; -1 if the fault affects all lower wires
int64 since          # number of the scan in which the fault was found
float64 deviations   # significance of the fault in standard deviations
""",
    FIELD_INFO: """\
# Data of a displacement field that sensor_msgs/PointCloud2 cannot contain. Its header is that of the cloud.
uint16 VERSION=1
std_msgs/Header header
string patch
int64 scan               # number of the scan, counted from the start of the host without wrap-around
uint8 counter            # scan number in the CAN frames
uint32 device_time_us    # time of the SYNC on the clock of the node, µs; 0 if unknown
int64 t_sync_ns          # times on the monotonic clock of the host, ns; 0 if unknown
int64 t_receive_ns
int64 t_solved_ns
bool trusted
bool tested              # whether the readings were tested
int8 touched             # 1 if the patch is touched, 0 if not, -1 if unknown
float64 touch_odds       # odds of touch to no touch; NaN if unknown
bool precise             # whether the standard deviations are within their limits
string distrust          # reason why the field is not trusted
string method            # exact or posterior
float64 noise_factor     # ratio of the estimated noise to the configured noise
uint8[] status           # status of each upper wire: 0 is CONVERGED
float64[] residual       # RMS of the relative residuals of each upper wire
bool[] wires_trusted     # empty if the readings were not tested
bool[] by_prior          # wires estimated with the prior; empty if there are none
bool[] held              # wires not solved again, because they had not changed; empty if there are none
float64[] gain           # relative gain error of each upper wire; empty if not estimated
uint32 evaluations
uint32 jacobians
uint32 steps
float64 solve_time_s
skinnode_msgs/DataFault[] faults
""",
    CONTACT: """\
# Contact of a body with the skin, in the frame of the patch. Names ending in _std are standard deviations.
uint16 VERSION=1
geometry_msgs/Point position         # centre of the normal load on the undeformed skin, m
geometry_msgs/Vector3 position_std
geometry_msgs/Vector3 normal         # unit vector out of the skin
geometry_msgs/Vector3 force          # force on the skin, N
float64[9] force_covariance          # N², row by row
float64 normal_force                 # N; positive if the body presses on the skin
float64 normal_force_std
float64[2] shear_force               # along and across the upper wires, N
float64[2] shear_force_std
float64 area                         # m²
float64 area_std
bool force_calibrated                # whether the forces are based on a calibration of the patch
""",
    CONTACTS: """\
# All contacts on a patch, strongest first; empty if nothing touches the patch.
uint16 VERSION=1
std_msgs/Header header
string patch
int64 scan
bool trusted
skinnode_msgs/Contact[] contacts
""",
    FIELD: """\
# Displacement field of a patch in double precision, complete. Published only over a network.
uint16 VERSION=2
skinnode_msgs/FieldInfo info
int64 started_ns         # time since 1970 at which the publisher started, ns; identifies its run
uint64 sequence          # number of the field of this patch in this run, from 1; a gap is a lost field
int64 sent_ns            # time since 1970 at which the publisher sent the field, ns
int64 wall_minus_mono_ns # time since 1970 minus the monotonic clock of the host, ns
uint32 layout_hash       # identifies the layout with which the field was computed
uint32 upper_wires
uint32 electrodes        # per upper wire
float64[] displacement   # (upper wire, electrode, axis), m, as all arrays below
float64[] displacement_std
float64[] core_std       # standard deviation without enlargement; empty if equal to displacement_std
float64[] force          # N; empty if not computed
float64[] data_share     # empty if all fractions are 1
skinnode_msgs/Contact[] contacts
float64[] contact_axes   # (contact, axis, coordinate): axes along and across the upper wires, and normal
""",
    HEALTH_REPORT: """\
# Health of all patches and buses, and the counters of the publisher. Published only over a network.
uint16 VERSION=1
std_msgs/Header header
int64 started_ns         # time since 1970 at which the publisher started, ns; identifies its run
string json              # patches, buses, published (fields by patch) and dropped (fields)
""",
    JOURNAL_LINE: """\
# Line of the journal of a recording, as JSON. The first line contains the hand.
uint16 VERSION=1
string json
""",
}
"""Definition of each message, by name."""

_VERSION: Final = re.compile(r"^uint16 VERSION\s*=\s*(\d{1,5})\b", re.MULTILINE)


def version_of(definition: str) -> int | None:
    """Return the ``VERSION`` constant of a message definition; None if the definition has none."""
    match = _VERSION.search(definition)
    return None if match is None else int(match[1])
