"""The only users of python-can at run time: a port on a bus and the thread that empties it."""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort
from skinnode.transport.receiver import Receiver

__all__ = ["CanPort", "Frame", "Receiver"]
