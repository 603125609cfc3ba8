"""Exact tracker: solves each upper wire of a live stream, starting from its solution for the previous frame.

``tracker`` runs the stages of a solve. ``stream`` contains the arrays of a stream and the acceptance test for
roots. ``recover_lost_wires`` retries wires that failed. ``fixed_coordinates`` reduces the number of unknowns.
``load_fit`` estimates the loads that explain a solved field, and ``contacts`` finds its contacts.
"""
