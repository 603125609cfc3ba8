"""A conformance suite for CANopen nodes: 127 cases in raw frames, against any node on any interface.

Knows a node by its EDS and by what it says on the bus, and shares no code with the node of this project: the
tester, its SDO client and its reader of EDS files are its own. The suite deliberately keeps its own CiA
constants, so that a wrong number in :mod:`skinnode.canopen` fails a case.
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
