"""Jobs of sub-maps know the reconstruction that they belong to."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade to this version."""
    with op.batch_alter_table("jobs") as jobs:
        jobs.add_column(sa.Column("parent_id", sa.String(length=40), nullable=True))
        jobs.create_index(op.f("ix_jobs_parent_id"), ["parent_id"])


def downgrade() -> None:
    """Return to the version before: a reconstruction that waits for sub-maps maps the drive by itself."""
    op.execute("UPDATE jobs SET waiting_for = 0, children_percent = 0 WHERE kind = 'RECONSTRUCTION'")
    submaps = "SELECT id FROM jobs WHERE kind = 'SUBMAP'"
    for table in ("job_attempts", "job_events"):
        op.execute(f"DELETE FROM {table} WHERE job_id IN ({submaps})")
    op.execute("DELETE FROM jobs WHERE kind = 'SUBMAP'")
    with op.batch_alter_table("jobs") as jobs:
        jobs.drop_index(op.f("ix_jobs_parent_id"))
        jobs.drop_column("parent_id")
