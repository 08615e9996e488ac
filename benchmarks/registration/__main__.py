"""`python -m benchmarks.registration`: see `walks`."""

from benchmarks.registration.walks import main

main()
