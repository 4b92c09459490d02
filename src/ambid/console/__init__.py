"""The console: a page in the browser that shows records, runs, live signals and commissioning of a folder.

The server (`server.py`) acquires nothing. Whatever computes or acquires is a process of its own (`worker.py`) that
appends what it finds to a feed, a file (`feed.py`); the server passes feeds on, and finds running workers again.
"""
