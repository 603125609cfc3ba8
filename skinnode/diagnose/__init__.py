"""Work on an open bus: find nodes, read and write their objects, tare, and find out what is wrong.

``bus_connection`` opens a bus and ``bus_listener`` keeps what is heard on it. The commands of
:mod:`skinnode.cli` call plain functions on a connection: ``discovery`` (which nodes are there),
``node_info``, ``object_dictionary`` with ``data_sheet``, ``standard_objects`` and ``dcf``,
``pdo_parameters``, ``nmt_commands``, ``lss_commissioning``, ``tare``. Nothing writes to a node unless its
name says so.

``skinnode doctor`` goes on from there: ``collect_facts`` (with ``scan_capture``) gathers facts of a bus,
:mod:`skinnode.diagnose.checks` draws findings from the facts (with ``noise``), ``root_causes`` groups
findings by cause, ``html_report`` writes the page.
"""
