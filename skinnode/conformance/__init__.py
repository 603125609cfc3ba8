"""Conformance suite for CANopen nodes: 127 cases that test any node with raw frames on any CAN interface.

``eds_reader`` parses the device's EDS, and ``tester`` sends and receives frames. ``sdo`` (the SDO
client) and ``dut`` (the device under test) build on these two modules, and the cases build on ``sdo`` and
``dut``. ``run`` resets the device before each case and restores its configuration; ``report`` and
``html_report`` write the results.

The suite relies only on a node's EDS and on the frames that the node sends. The suite has its own tester,
SDO client, EDS reader and constants, because it could not detect errors in code shared with the node.
"""

from skinnode.conformance.case import Case, NotApplicable, Result, Verdict
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds_reader import Eds, parse_eds, parse_eds_file
from skinnode.conformance.run import Report, connect, run_case, run_cases
from skinnode.conformance.suite import CASES, select

__all__ = [
    "CASES",
    "Case",
    "Dut",
    "Eds",
    "NotApplicable",
    "Report",
    "Result",
    "Verdict",
    "connect",
    "parse_eds",
    "parse_eds_file",
    "run_case",
    "run_cases",
    "select",
]
