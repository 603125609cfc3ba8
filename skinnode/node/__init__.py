"""A patch as a CANopen device (CiA 301), and the thread that runs patches on a bus.

::

    runner (thread, CAN port) -> device (a frame to its service) -> one file per service -> device -> runner

The sub-package ``patch`` is the application that uses these services: it samples the skin and sends scans.
"""

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.canopen.nmt import NmtState
from skinnode.node.clock import EXACT, THRIFTY, Pacing
from skinnode.node.memory import Memory, VolatileMemory
from skinnode.node.memory_file import FileMemory
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
