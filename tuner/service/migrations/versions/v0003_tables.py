"""The tables of 0.2.0, which `Database.migrate` makes by their classes: later ones change them."""

revision = "0003"
down_revision = None


def upgrade() -> None:
    """Change nothing."""
