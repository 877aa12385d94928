// Markup as tagged templates: no compiler step of its own, and expressions are type-checked.
import { h, type ComponentChildren, type VNode } from "preact";
import htm from "htm";

export const html = htm.bind(h) as (strings: TemplateStringsArray, ...values: unknown[]) => VNode;
export type Children = ComponentChildren;
export type Shown = VNode | null;
