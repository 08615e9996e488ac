"""How the networks in the package were trained: random captures, damaged graphs, and the scripts that use them."""
