"""Fixtures that these tests share with those of the evaluation."""

from tests.evaluation.conftest import *  # noqa: F403
