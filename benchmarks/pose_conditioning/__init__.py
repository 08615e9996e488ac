"""Poses from the true surface alone: what first-order and second-order steps make of them."""
