"""What all black-box estimators share: data in, models, results, files."""
