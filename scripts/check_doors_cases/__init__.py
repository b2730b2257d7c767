"""Cases of scripts/check_doors: walls with doors, walks at them, and an ideal disc as the judge."""
