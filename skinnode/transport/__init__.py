"""Access CAN interfaces: bus ports, their receiving threads, and frame log files.

The module ``socketcan`` receives batches of frames with the system call recvmmsg(2), and reads the kernel's
counter of dropped frames. ``port`` sends and counts frames and reopens failed interfaces; ``receiver``
contains the receiving threads.

No other package in the project uses python-can at run time.
"""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort, open_can_bus
from skinnode.transport.receiver import Intake, Receiver

__all__ = ["CanPort", "Frame", "Intake", "Receiver", "open_can_bus"]
