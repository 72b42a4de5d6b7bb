pub fn grasp_html() {}
