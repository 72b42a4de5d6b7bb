pub struct SheetObject; pub fn contact_sheet() {}
