"""Moves solved fields to one time, if the upper wires of a scan are sampled one after the other.

``scan_skew`` interpolates the displacements and loads of a stream's fields, wire by wire, and owns the last
fields. ``contact_skew`` does the same with their contacts. ``interpolation`` states how uncertain an
interpolated value is.
"""
