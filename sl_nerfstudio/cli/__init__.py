"""One module per command: its flags, the checks that need only the flags, and the words that it prints.

In: a command line. Out: calls into the other folders, text on the terminal and an exit status. Slow imports are inside
functions, so that `--help` is quick.
"""
