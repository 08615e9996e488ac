"""The parts of sl-export's command line: its flags, what is checked before anything slow, and what it prints.

In: the command line, and what an export hands back. Out: its settings, UserErrors with a remedy, and the summary.
"""
