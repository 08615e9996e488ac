"""Reports as single HTML files that need no network.

In: an evaluation with its inputs, or the result of processing photographs. Out: the text of a page with its charts,
pictures and an interactive view embedded.
"""
