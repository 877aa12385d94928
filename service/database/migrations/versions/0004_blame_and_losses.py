"""Attempts that count against their job, and those that do not."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade to this version."""
    with op.batch_alter_table("jobs") as jobs:
        jobs.add_column(sa.Column("blame", sa.Double(), nullable=False, server_default="0"))
        jobs.add_column(sa.Column("losses", sa.BigInteger(), nullable=False, server_default="0"))
        jobs.add_column(sa.Column("engine_ran", sa.Boolean(), nullable=False, server_default=sa.false()))
        jobs.add_column(sa.Column("memory_kills", sa.BigInteger(), nullable=True))
    # What was lost and what failed was not told apart.
    op.execute("UPDATE jobs SET blame = failures")
    with op.batch_alter_table("jobs") as jobs:  # the defaults were for the rows that are there
        jobs.alter_column("blame", server_default=None)
        jobs.alter_column("losses", server_default=None)
        jobs.alter_column("engine_ran", server_default=None)
        jobs.drop_column("failures")


def downgrade() -> None:
    """Return to the version before."""
    with op.batch_alter_table("jobs") as jobs:
        jobs.add_column(sa.Column("failures", sa.BigInteger(), nullable=False, server_default="0"))
    op.execute("UPDATE jobs SET failures = CAST(blame AS BIGINT)")
    with op.batch_alter_table("jobs") as jobs:
        jobs.alter_column("failures", server_default=None)
        for name in ("blame", "losses", "engine_ran", "memory_kills"):
            jobs.drop_column(name)
