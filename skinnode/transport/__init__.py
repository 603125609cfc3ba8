"""CAN interfaces: bus ports, their receiving threads, and frame log files.

``socketcan`` receives batches of frames through the system call in ``recvmmsg``, and reads how many frames
the kernel dropped; ``port`` sends, counts and reopens; ``receiver`` contains the receiving threads.

No other package in the project uses python-can at run time.
"""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort
from skinnode.transport.receiver import Intake, Receiver

__all__ = ["CanPort", "Frame", "Intake", "Receiver"]
