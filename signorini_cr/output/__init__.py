"""The files that a run leaves behind.

Report, tables, fields and pictures, in files that appear whole or not at all.
"""
