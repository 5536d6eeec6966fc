"""Model only what a scene needs: settings that follow from it, and what each cheaper one would cost."""
