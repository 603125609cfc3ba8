"""CAN interfaces: ports on buses, the threads that receive on them, and log files of frames.

No other room uses python-can at run time.
"""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort
from skinnode.transport.receiver import Intake, Receiver

__all__ = ["CanPort", "Frame", "Intake", "Receiver"]
