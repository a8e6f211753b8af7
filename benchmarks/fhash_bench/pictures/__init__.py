"""Pictures: what each effect costs, and VTK and OSPRay beside."""

from __future__ import annotations
