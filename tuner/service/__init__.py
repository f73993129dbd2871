"""The tuning service: jobs of many people in one table, worked off by processes of their own.

The table is the truth: a server or a worker that is killed leaves nothing that it does not say.
"""
