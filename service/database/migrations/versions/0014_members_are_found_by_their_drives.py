"""Aggregations that bring a drive are found by an index: each deletion of a drive asks for them."""

from __future__ import annotations

from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

_INDEX = "ix_job_members_drive_id"


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_index(op.f(_INDEX), "job_members", ["drive_id"])


def downgrade() -> None:
    """Return to the version before."""
    op.drop_index(op.f(_INDEX), "job_members")
