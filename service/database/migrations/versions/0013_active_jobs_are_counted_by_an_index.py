"""Active jobs of a project are counted by an index, and its history is not read for it."""

from __future__ import annotations

from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

_INDEX = "ix_jobs_project_id_state_kind"


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_index(op.f(_INDEX), "jobs", ["project_id", "state", "kind"])


def downgrade() -> None:
    """Return to the version before."""
    op.drop_index(op.f(_INDEX), "jobs")
