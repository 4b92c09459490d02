"""Judging estimates: on their own record, on another, and against each other."""
