"""Finds, reads, configures and diagnoses the nodes on a bus, for the commands of :mod:`skinnode.cli`.

``bus_connection`` opens a bus, and ``bus_listener`` records the messages received on it. The other modules
contain functions that take a connection:

* ``discovery`` finds the nodes.
* ``node_info`` and ``pdo_parameters`` read the settings of a node.
* ``object_dictionary`` reads and compares objects. ``data_sheet``, ``standard_objects`` and ``dcf`` supply
  their names, types and expected values.
* ``nmt_commands``, ``lss_commissioning`` and ``tare`` change the state or the settings of a node.

``skinnode doctor`` uses ``collect_facts`` and ``scan_capture`` to collect facts about a bus,
:mod:`skinnode.diagnose.checks` and ``noise`` to derive findings from the facts, ``root_causes`` to group the
findings, and ``html_report`` to write the report.
"""
