"""The tuning service: jobs of many people in one table, each fitted by a process of its own.

The table is the truth: a server or a worker that is killed leaves nothing that it does not say.
"""
