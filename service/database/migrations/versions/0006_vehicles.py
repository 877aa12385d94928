"""Drives know the vehicle that their manifest names."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade to this version: manifests that are there have no such field."""
    with op.batch_alter_table("drives") as drives:
        drives.add_column(sa.Column("vehicle", sa.String(length=64), nullable=True))
        drives.create_index(
            op.f("ix_drives_project_id_vehicle_created_us_id"), ["project_id", "vehicle", "created_us", "id"]
        )


def downgrade() -> None:
    """Return to the version before, which refuses new manifests with a vehicle and reads none."""
    with op.batch_alter_table("drives") as drives:
        drives.drop_index(op.f("ix_drives_project_id_vehicle_created_us_id"))
        drives.drop_column("vehicle")
