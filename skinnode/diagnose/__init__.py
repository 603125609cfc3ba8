"""Operations on an open bus: finding nodes, reading and writing their objects, taring, and diagnosis.

``bus_connection`` opens a bus and ``bus_listener`` records the messages received on it. The commands of
:mod:`skinnode.cli` call plain functions that take a connection: ``discovery`` (which nodes are present),
``node_info``, ``object_dictionary`` with ``data_sheet``, ``standard_objects`` and ``dcf``,
``pdo_parameters``, ``nmt_commands``, ``lss_commissioning``, ``tare``. A function writes to a node only if its
name indicates a write.

``skinnode doctor`` builds on these modules. ``collect_facts`` uses ``scan_capture`` to gather the
facts about a bus. :mod:`skinnode.diagnose.checks` uses ``noise`` to derive findings from the facts.
``root_causes`` groups findings by cause, and ``html_report`` writes the report as a page.
"""
