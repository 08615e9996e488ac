"""Tests of captures as people have them."""
