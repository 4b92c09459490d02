"""What the jobs may be told, declared once, and how a setting is called where it is given."""
