"""The matrix of faults: what is planted, and what must come of it.

A fault is named in one line, or the flight survives it with the incident counted; nothing is lost, and nothing outside
is touched. Each module is a family and reads as a table: recordings that are wrong (:mod:`test_inputs`), files that are
broken (:mod:`test_files`), parts that fail (:mod:`test_parts`), a machine that has run out of something
(:mod:`test_resources`), runs that are killed (:mod:`test_kills`), and files mutated at random (``test_fuzz_*``).
"""
