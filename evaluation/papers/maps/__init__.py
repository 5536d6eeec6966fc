"""Maps that are saved, found again, continued, merged and changed: scenarios, measures and rows."""
