"""Several secrets that were replaced sign side by side, each to its own end."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_TABLE = "webhook_old_secrets"
_MOVED = f"""
    INSERT INTO {_TABLE} (webhook_id, secret, until_us)
    SELECT id, previous_secret, previous_until_us FROM webhooks
    WHERE previous_secret IS NOT NULL AND previous_until_us IS NOT NULL
"""
_MOVED_BACK = f"""
    UPDATE webhooks SET
        previous_secret = (
            SELECT secret FROM {_TABLE} AS s WHERE s.webhook_id = webhooks.id ORDER BY until_us DESC, secret LIMIT 1
        ),
        previous_until_us = (SELECT max(until_us) FROM {_TABLE} AS s WHERE s.webhook_id = webhooks.id)
"""


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_table(
        _TABLE,
        sa.Column("webhook_id", sa.String(length=40), nullable=False),
        sa.Column("secret", sa.String(length=200), nullable=False),
        sa.Column("until_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["webhook_id"], ["webhooks.id"], name=op.f(f"fk_{_TABLE}_webhook_id_webhooks"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("webhook_id", "secret", name=op.f(f"pk_{_TABLE}")),
    )
    op.create_index(op.f(f"ix_{_TABLE}_until_us"), _TABLE, ["until_us"])
    op.execute(_MOVED)
    with op.batch_alter_table("webhooks") as webhooks:
        webhooks.drop_column("previous_until_us")
        webhooks.drop_column("previous_secret")


def downgrade() -> None:
    """Return to the version before, in which one secret before the present one signs."""
    with op.batch_alter_table("webhooks") as webhooks:
        webhooks.add_column(sa.Column("previous_secret", sa.String(length=200), nullable=True))
        webhooks.add_column(sa.Column("previous_until_us", sa.BigInteger(), nullable=True))
    op.execute(_MOVED_BACK)
    op.drop_table(_TABLE)
