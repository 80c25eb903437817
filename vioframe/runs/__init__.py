"""The run folder: written by the recorder, read by evaluation and reports."""
