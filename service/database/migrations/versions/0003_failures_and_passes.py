"""Failures are counted apart from attempts; when the long passes of the reconciler were made."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade to this version."""
    with op.batch_alter_table("jobs") as jobs:
        jobs.add_column(sa.Column("failures", sa.BigInteger(), nullable=False, server_default="0"))
    with op.batch_alter_table("jobs") as jobs:  # the default was for the rows that are there
        jobs.alter_column("failures", server_default=None)
    # Until now the number of a released attempt was taken back: what was counted had failed, or is under way.
    op.execute(
        "UPDATE jobs SET failures = CASE WHEN state = 'QUEUED' THEN attempt ELSE attempt - 1 END WHERE attempt > 0"
    )
    op.create_table(
        "passes",
        sa.Column("name", sa.String(length=40), nullable=False),
        sa.Column("done_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_passes")),
    )


def downgrade() -> None:
    """Return to the version before."""
    op.drop_table("passes")
    op.execute(
        "UPDATE jobs SET attempt = CASE WHEN state = 'RUNNING' THEN failures + 1 ELSE failures END "
        "WHERE state IN ('QUEUED', 'RUNNING')"
    )
    with op.batch_alter_table("jobs") as jobs:
        jobs.drop_column("failures")
