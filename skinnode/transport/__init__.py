"""Access to CAN interfaces: ports, receiving threads and log files.

``port`` sends and receives frames, and reopens failed interfaces. ``socketcan`` receives batches of frames
with recvmmsg(2), and ``hardware_time`` converts their hardware timestamps. ``multicast`` exchanges frames in
batches and is compatible with python-can's udp_multicast interface; ``sendto`` sends its packets, and
``socket_options`` sets up its sockets. ``receiver`` contains the receiving threads. ``frame_log`` and
``frame_log_reader`` write and read log files.

No other package of this project uses python-can at run time.
"""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort, open_can_bus
from skinnode.transport.receiver import Intake, Receiver

__all__ = ["CanPort", "Frame", "Intake", "Receiver", "open_can_bus"]
