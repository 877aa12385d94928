"""Webhooks and their deliveries."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ForeignKey, Index, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from service.database.tables._base import Base, Id, new_id, now_us


class Webhook(Base):
    """An address of a project that is told when jobs end. Its secrets have to be readable: they sign."""

    __tablename__ = "webhooks"
    __table_args__ = (Index(None, "project_id", "created_us", "id"),)

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("whk"))
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    url: Mapped[str] = mapped_column(String(2000))
    events: Mapped[list[Any]]
    description: Mapped[str] = mapped_column(String(200))
    secret: Mapped[str] = mapped_column(String(200))
    disabled_us: Mapped[int | None]
    created_us: Mapped[int] = mapped_column(default=now_us)


class WebhookOldSecret(Base):
    """A secret that was replaced. Until its end it signs beside the webhook's own."""

    __tablename__ = "webhook_old_secrets"

    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"), primary_key=True)
    secret: Mapped[str] = mapped_column(String(200), primary_key=True)
    until_us: Mapped[int] = mapped_column(index=True)


class WebhookDelivery(Base):
    """A message to a webhook: recorded in the transaction that ends its job, sent by a reconciler."""

    __tablename__ = "webhook_deliveries"
    __table_args__ = (
        UniqueConstraint("webhook_id", "job_id"),  # a job ends once
        Index(None, "webhook_id", "created_us", "id"),
        Index(None, "state", "next_us"),
        Index(None, "webhook_id", "state", "next_us"),
    )

    id: Mapped[str] = mapped_column(Id, primary_key=True, default=lambda: new_id("msg"))
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    job_id: Mapped[str] = mapped_column(Id)  # no foreign key: the job's record may go first
    event: Mapped[str] = mapped_column(String(40))
    body: Mapped[str] = mapped_column(Text)  # as it is signed and sent, at every try the same
    state: Mapped[str] = mapped_column(String(16))
    attempts: Mapped[int] = mapped_column(default=0)
    next_us: Mapped[int]  # of a pending one: while it is being sent, when another may send it
    status: Mapped[int | None]
    error: Mapped[str | None] = mapped_column(String(300))
    created_us: Mapped[int] = mapped_column(default=now_us)
    delivered_us: Mapped[int | None]
