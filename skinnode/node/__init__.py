"""CANopen node (CiA 301) for a patch, and the thread that runs nodes on a bus.

``runner`` contains the thread, which passes received frames to ``device``. The device passes each frame to
the service that handles it; every service has its own module. The sub-package ``patch`` is the application,
which measures the skin and sends scans.
"""

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.canopen.nmt import NmtState
from skinnode.node.memory import Memory, VolatileMemory
from skinnode.node.memory_file import FileMemory
from skinnode.node.pacing import EXACT, THRIFTY, Pacing
from skinnode.node.patch.patch_node import PatchNode
from skinnode.node.patch.source import ResistanceSource
from skinnode.node.runner import NodeRunner

__all__ = [
    "EXACT",
    "NOT_CONFIGURED",
    "THRIFTY",
    "FileMemory",
    "Memory",
    "NmtState",
    "NodeRunner",
    "Pacing",
    "PatchNode",
    "ResistanceSource",
    "VolatileMemory",
]
