"""Which tooth is which: labellings compared by their evidence."""
