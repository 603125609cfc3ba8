"""Conformance suite for CANopen nodes: test cases for any node on any CAN interface.

``eds_reader`` parses the EDS of the node, and ``tester`` sends and receives raw frames. ``sdo`` is the SDO
client, ``dut`` represents the device under test, and ``cases`` contains the cases. ``run`` runs the cases,
and ``report`` and ``html_report`` format the results.

The suite uses only the EDS of the node and the frames that the node sends. It has its own SDO client, EDS
reader and constants, because it could not detect an error in code that it shared with the node.
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
