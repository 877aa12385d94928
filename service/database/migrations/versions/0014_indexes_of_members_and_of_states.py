"""Members are found by their drives, and a heartbeat changes no column that an index has.

Each deletion of a drive asks for the aggregations that bring it. In PostgreSQL a row of which an indexed column changes
gets a new entry in every index of its table; a running job reports itself each second.
"""

from __future__ import annotations

from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

_OF_MEMBERS, _OF_STATES, _OF_LEASES = "ix_job_members_drive_id", "ix_jobs_state", "ix_jobs_state_lease_until_us"


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_index(op.f(_OF_MEMBERS), "job_members", ["drive_id"])
    op.create_index(op.f(_OF_STATES), "jobs", ["state"])
    op.drop_index(op.f(_OF_LEASES), "jobs")


def downgrade() -> None:
    """Return to the version before."""
    op.create_index(op.f(_OF_LEASES), "jobs", ["state", "lease_until_us"])
    op.drop_index(op.f(_OF_STATES), "jobs")
    op.drop_index(op.f(_OF_MEMBERS), "job_members")
