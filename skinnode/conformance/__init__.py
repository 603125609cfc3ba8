"""Conformance suite for CANopen nodes: 127 cases that test any node on any interface with raw frames.

``eds_reader`` parses the device's EDS, and ``tester`` sends and receives frames. ``sdo`` and ``dut`` (the
device under test) build on both, and the cases use ``sdo`` and ``dut``. ``run`` resets the device before each
case and restores its configuration; ``report`` and ``html_report`` write the results.

The suite relies only on a node's EDS and its frames. It has its own tester, SDO client, EDS reader
and constants, because an error in code that the suite shared with the node would go unnoticed.
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
