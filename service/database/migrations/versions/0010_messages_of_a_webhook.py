"""An index of the messages of one webhook that are due."""

from __future__ import annotations

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

_INDEX = "ix_webhook_deliveries_webhook_id_state_next_us"


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_index(op.f(_INDEX), "webhook_deliveries", ["webhook_id", "state", "next_us"])


def downgrade() -> None:
    """Return to the version before."""
    op.drop_index(_INDEX, "webhook_deliveries")
