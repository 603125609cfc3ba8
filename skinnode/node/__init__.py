"""A patch as a CANopen device (CiA 301), and the thread that drives patches on a bus."""

from skinnode.canopen.lss import NOT_CONFIGURED
from skinnode.canopen.nmt import NmtState
from skinnode.node.clock import EXACT, THRIFTY, Pacing
from skinnode.node.memory import FileMemory, Memory, VolatileMemory
from skinnode.node.node import PatchNode
from skinnode.node.runner import NodeRunner
from skinnode.node.source import ResistanceSource

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
