"""The history of the tables, as Alembic goes through it."""
