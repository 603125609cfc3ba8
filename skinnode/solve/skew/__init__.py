"""Moves solved fields to a single point in time if the upper wires of a scan are sampled one after the other.

``scan_skew`` interpolates the displacements and loads of a stream's fields, wire by wire, and stores the last
fields. ``contact_skew`` does the same for their contacts. ``interpolation`` computes the uncertainty of an
interpolated value.
"""
